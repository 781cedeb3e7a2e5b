"""Colours between pixel centres, and which cameras see a surface."""

from __future__ import annotations

import torch

from clear_strategies.geometry.projection import sample_colors, times_seen
from rasterizers.interface import Camera
from tests.helpers import planes


def test_colours_are_sampled_between_pixel_centres() -> None:
    image = torch.tensor([[[0.0, 0, 0], [1.0, 1, 1]]])
    at = torch.tensor([[0.5, 0.5], [1.0, 0.5], [1.25, 0.5], [1.5, 0.5], [0.1, 0.2]])
    assert torch.allclose(sample_colors(image, at)[:, 0], torch.tensor([0, 0.5, 0.75, 1, 0]))


def camera(x: float) -> Camera:
    """A pixel is 0.1 wide at a depth of 1."""
    return planes.camera(x, 10, 10, 10.0)


def test_a_point_is_seen_where_it_is_inside_a_camera_and_not_hidden():
    wall = torch.full((10, 10), 1.0)
    across = torch.arange(10) / 10 - 0.45  # the centres of a row of pixels at a depth of 1
    points = torch.stack((across, torch.zeros(10) + 0.05, torch.ones(10)), dim=1)
    beside = times_seen(points, [(camera(0.5), wall), (camera(0.0), wall)])  # 5 pixels aside
    assert beside.tolist() == [1] * 5 + [2] * 5
    for depth, seen in ((wall * 0.5, 0), (wall * 2, 1), (wall * torch.nan, 0)):  # before, behind, unknown
        assert times_seen(points, [(camera(0.0), depth)]).unique().tolist() == [seen]
