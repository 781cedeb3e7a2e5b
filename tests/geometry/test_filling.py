"""Densification: exact on planes, occlusion-aware, and none on the background."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies.geometry.filling import densify
from clear_strategies.geometry.projection import project
from tests.helpers.planes import cloud_of, photo


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.sampled_from((1, 2, 4)))
@settings(max_examples=20, deadline=None)
def test_new_points_lie_on_the_plane_of_the_old_ones(a: float, b: float, stride: int) -> None:
    """Inverse depth is linear in pixels on the plane z = 5 + a x + b y."""
    view = photo()
    u, v = torch.meshgrid(torch.linspace(0.1, 39.9, 9), torch.linspace(0.1, 39.9, 9), indexing="ij")
    rays = torch.stack(((u - 20) / 100, (v - 20) / 100, torch.ones_like(u)), -1).reshape(-1, 3)
    plane = rays * (5 / (1 - rays[:, :1] * a - rays[:, 1:2] * b))
    cloud = densify(cloud_of(plane), [view], stride)
    new = cloud.means[len(plane) :]
    assert len(new) == (40 // stride) ** 2
    assert torch.equal(cloud.means[: len(plane)], plane)
    exact = 5 + a * new[:, 0] + b * new[:, 1]
    assert ((new[:, 2] / exact - 1).abs() < 0.012).all()  # samples count at the centres of their pixels
    assert f"densified by {len(new):,}" in cloud.source


def test_a_new_point_has_the_colour_of_its_pixel() -> None:
    view = photo()
    cloud = densify(cloud_of(torch.randn(50, 3) * 0.2 + torch.tensor([0, 0, 5.0])), [view], 1)
    pixels, _ = project(view.camera, cloud.means[50:])
    column, row = pixels.long().T
    assert torch.allclose(pixels - pixels.floor(), torch.full_like(pixels, 0.5), atol=1e-3)
    assert torch.allclose(cloud.colors[50:], view.image[row, column], atol=1e-4)


def test_points_hidden_behind_a_surface_do_not_bend_it() -> None:
    u, v = torch.meshgrid(torch.arange(-1, 1, 0.05), torch.arange(-1, 1, 0.05), indexing="ij")
    front = torch.stack((u, v, torch.full_like(u, 5.0)), -1).reshape(-1, 3)
    behind = front * torch.tensor([1, 1, 2.0]) + torch.tensor([0.01, 0.01, 0])
    new = densify(cloud_of(torch.cat((front, behind))), [photo()], 2).means[2 * len(front) :]
    assert torch.allclose(new[:, 2], torch.tensor(5.0), atol=1e-4)


def test_the_background_and_what_a_mask_hides_get_no_points() -> None:
    view, left = photo(), torch.arange(40).expand(40, 40) < 30
    white = replace(view, image=torch.where(left[..., None], 1.0, view.image))
    hiding = replace(view, shown=~left)
    points = cloud_of(torch.randn(200, 3) * 0.4 + torch.tensor([0, 0, 5.0]))
    for seen, background in ((white, (1.0, 1.0, 1.0)), (hiding, None)):
        new = densify(points, [seen], 1, background).means[200:]
        assert len(new) == 10 * 40
        assert bool((project(view.camera, new)[0][:, 0] > 30).all())
    assert len(densify(points, [hiding, view], 1)) == 200 + 10 * 40 + 40 * 40


def test_points_on_a_line_are_enough() -> None:
    line = torch.stack((torch.linspace(-0.5, 0.5, 30), torch.zeros(30), torch.full((30,), 5.0)), dim=1)
    new = densify(cloud_of(line), [photo()], 2).means[30:]
    assert torch.allclose(new[:, 2], torch.tensor(5.0))


def test_without_points_in_view_nothing_is_added_and_said(caplog: pytest.LogCaptureFixture) -> None:
    cloud = cloud_of(torch.tensor([[0.0, 0, -5]]).repeat(10, 1))
    assert densify(cloud, [photo()], 2) is cloud
    assert "only 0 points project into it" in caplog.text
    assert "added no point" in caplog.text
