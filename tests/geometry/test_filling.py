"""Points: densification, outliers and voxels, and those of depth maps."""

import sys
from dataclasses import replace

import pytest
import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.geometry.cleaning import averaged_in_voxels, without_outliers
from clear_strategies.geometry.dense_stereo.cloud import points_of
from clear_strategies.geometry.filling import densify, grid_points
from clear_strategies.geometry.projection import project
from rasterizers.interface import BackendUnavailable
from tests.helpers.planes import cloud_of, depth_of, photo


@pytest.mark.parametrize(("a", "b", "stride"), [(-0.5, 0.5, 1), (0.3, 0.0, 2), (0.5, 0.5, 4)])
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


@pytest.mark.parametrize(("size", "stride"), [(40, 1), (40, 2), (40, 5), (300, 2), (300, 4), (300, 7)])
def test_points_beside_an_exact_depth_map_lie_on_its_plane_wherever_they_are_in_their_pixel(
    size: int, stride: int
) -> None:
    """Of 300 px, depth is completed at a third. The plane is z = 5 + x / 2."""
    view = replace(photo(size=size), image=torch.full((size, size, 3), 0.5))
    x = (torch.arange(size) + 0.5 - size / 2) / 100
    depth = (5 / (1 - x / 2)).repeat(size, 1)
    in_hole = torch.arange(size) // 9 % 3 == 1
    depth[in_hole[:, None] & in_hole] = torch.nan
    new = grid_points(torch.zeros(0, 3), [view], stride, maps=[depth_of(view, depth)])[0]
    assert len(new) > 0
    error = (new[:, 2] / (5 + new[:, 0] / 2) - 1).abs()
    assert error.max() < 2e-3


def test_a_new_point_has_the_colour_of_its_pixel_and_without_points_in_view_there_is_none(caplog):
    view = photo()
    cloud = densify(cloud_of(torch.randn(50, 3) * 0.2 + torch.tensor([0, 0, 5.0])), [view], 1)
    pixels, _ = project(view.camera, cloud.means[50:])
    column, row = pixels.long().T
    assert torch.allclose(pixels - pixels.floor(), torch.full_like(pixels, 0.5), atol=1e-3)
    assert torch.allclose(cloud.colors[50:], view.image[row, column], atol=1e-4)
    cloud = cloud_of(torch.tensor([[0.0, 0, -5]]).repeat(10, 1))
    assert densify(cloud, [photo()], 2) is cloud
    assert "only 0 points project into it" in caplog.text
    assert "added no point" in caplog.text


def test_points_behind_a_surface_do_not_bend_it_and_points_on_a_line_are_enough() -> None:
    u, v = torch.meshgrid(torch.arange(-1, 1, 0.05), torch.arange(-1, 1, 0.05), indexing="ij")
    front = torch.stack((u, v, torch.full_like(u, 5.0)), -1).reshape(-1, 3)
    behind = front * torch.tensor([1, 1, 2.0]) + torch.tensor([0.01, 0.01, 0])
    new = densify(cloud_of(torch.cat((front, behind))), [photo()], 2).means[2 * len(front) :]
    assert torch.allclose(new[:, 2], torch.tensor(5.0), atol=1e-4)
    line = torch.stack((torch.linspace(-0.5, 0.5, 30), torch.zeros(30), torch.full((30,), 5.0)), dim=1)
    new = densify(cloud_of(line), [photo()], 2).means[30:]
    assert torch.allclose(new[:, 2], torch.tensor(5.0))


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


# ---- outliers and voxels: small cases by hand
def test_outliers_are_removed() -> None:
    for line, ratio, kept in (
        # Mean distance to the 2 nearest, itself included: 1/2 four times and 96/2 once. Average 10, deviation 21.2.
        ([0, 1, 2, 3, 99], 1.7, [0, 1, 2, 3]),  # the limit is 46.1
        ([0, 1, 2, 3, 99], 1.8, [0, 1, 2, 3, 99]),  # 48.3
        ([0, 0, 1, 2], 3.0, [1, 2]),  # a point on its nearest one
        ([0, 0, 0], 3.0, [0, 0, 0]), ([0, 9], 0.1, [0, 9]), ([], 3.0, []),  # all would be removed
    ):  # fmt: skip
        means = torch.tensor(line)[:, None] * torch.tensor([1.0, 0, 0])
        assert without_outliers(PointCloud(means, means * 0, "given"), 2, ratio).means[:, 0].tolist() == kept


def test_voxels_hold_the_averages_of_their_points_or_say_what_to_install(monkeypatch):
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "open3d", None)  # makes its import fail
        with pytest.raises(BackendUnavailable, match=r"data\.cloud\.voxel needs Open3D.*pip install .*\[open3d\]"):
            averaged_in_voxels(PointCloud(torch.rand(4, 3), torch.rand(4, 3), "given"), 0.1)
    pytest.importorskip("open3d", exc_type=ImportError)  # 0.20 without libusb, too
    means = torch.tensor([[0.0, 0, 0], [5.0, 0, 0], [0.2, 0.1, 0], [0.0, 5, 0]])
    cloud = averaged_in_voxels(PointCloud(means, means / 5, "given"), 1.0)
    assert torch.allclose(cloud.means, torch.tensor([[0.1, 0.05, 0], [0.0, 5, 0], [5.0, 0, 0]]))
    assert torch.allclose(cloud.colors, cloud.means / 5)
    assert cloud.source == "given, in voxels of 1"


# ---- points from depth maps: their spacing, what several photos see, and what fills the rest
@pytest.mark.parametrize(("spacing", "count"), [(1.0, 1600), (2.0, 400), (1.6, 625)])
def test_there_is_one_point_per_square(spacing: float, count: int) -> None:
    view = photo()
    means, colors = points_of([view], [depth_of(view, 5.0)], spacing, 0.02)
    assert len(means) == len(colors) == count
    assert torch.allclose(means[:, 2], torch.tensor(5.0))


def test_what_two_photos_see_gets_its_points_once_from_the_most_confident_pixel_of_a_square() -> None:
    views = [photo(), photo()]
    assert len(points_of(views, [depth_of(v, 5.0) for v in views], 2.0, 0.02)[0]) == 400
    apart = [depth_of(views[0], 5.0), depth_of(views[1], 6.0)]
    assert len(points_of(views, apart, 2.0, 0.02)[0]) == 800
    view = photo()
    result = depth_of(view, 5.0)
    result.confidence[:] = 0.5
    result.depth[1::2, 1::2] = 7.0
    result.confidence[1::2, 1::2] = 0.6
    assert (points_of([view], [result], 2.0, 0.02)[0][:, 2] == 7).all()


def test_only_unknown_pixels_are_filled_and_never_in_known_free_space() -> None:
    views = [photo(), photo(0.1)]
    samples = torch.cat((torch.rand(60, 2) - 0.5, torch.full((60, 1), 3.0)), dim=1)
    assert len(grid_points(samples, views, 2, maps=[depth_of(v, 5.0) for v in views])[0]) == 0
    assert len(grid_points(samples, views, 2, maps=[depth_of(v, torch.nan) for v in views])[0]) == 800
    floating = grid_points(samples, views, 2, maps=[depth_of(views[0], torch.nan), depth_of(views[1], 5.0)])[0]
    assert len(floating) < 100
    close = grid_points(samples, views, 2, maps=[depth_of(views[0], torch.nan), depth_of(views[1], 3.1)])[0]
    assert len(close) == 400  # within 5 % of what the other photo knows
