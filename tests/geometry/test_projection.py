"""Colours between pixel centres, and which cameras see a surface."""

from __future__ import annotations

import torch

from clear_strategies.geometry.projection import sample_colors
from clear_strategies.geometry.visibility import seen_by
from rasterizers.interface import Camera
from tests.helpers import planes


def test_colours_are_sampled_between_pixel_centres() -> None:
    image = torch.tensor([[[0.0, 0, 0], [1.0, 1, 1]]])
    at = torch.tensor([[0.5, 0.5], [1.0, 0.5], [1.25, 0.5], [1.5, 0.5], [0.1, 0.2]])
    assert torch.allclose(sample_colors(image, at)[:, 0], torch.tensor([0, 0.5, 0.75, 1, 0]))


def camera(x: float) -> Camera:
    """A pixel is 0.1 wide at a depth of 1."""
    return planes.camera(x, 10, 10, 10.0)


def test_a_pixel_is_seen_where_its_surface_is_inside_another_camera_and_not_hidden():
    wall = torch.full((10, 10), 1.0)
    beside = seen_by(camera(0.0), wall, [(camera(0.5), wall), (camera(0.0), wall)])  # 5 pixels aside
    assert beside[:, :5].unique().tolist() == [1]
    assert beside[:, 5:].unique().tolist() == [2]
    assert seen_by(camera(0.0), wall, [(camera(0.0), wall * 0.5)]).max() == 0  # something stands before it
    assert seen_by(camera(0.0), wall, [(camera(0.0), wall * 2)]).min() == 1
    assert seen_by(camera(0.0), torch.full((10, 10), torch.nan), [(camera(0.0), wall)]).max() == 0
    assert seen_by(camera(0.0), wall, [(camera(0.0), torch.full((10, 10), torch.nan))]).max() == 0
