"""Outliers and voxels: small cases by hand, and Open3D and SciPy agreeing on a cloud like real ones."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies.geometry.cleaning import remove_outliers, voxel_grid


def without_open3d(patch: pytest.MonkeyPatch) -> None:
    patch.setitem(sys.modules, "open3d", None)  # makes its import fail


def require_open3d() -> None:
    """Skip without open3d, except in CI, where it must be there."""
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as reason:
        if "CI" in os.environ:
            raise
        pytest.skip(f"open3d cannot be imported: {reason}")


def room(n: int = 3000) -> Tensor:
    """Two walls of uneven density with noise, strays around them, and points that coincide."""
    rng = np.random.default_rng(0)
    walls = rng.random((n, 3)) ** [1, 2, 1] * [4, 3, 0.02]
    walls[n // 2 :] = walls[n // 2 :, [2, 1, 0]]
    strays = rng.normal(size=(60, 3)) * 5
    return torch.from_numpy(np.concatenate((walls, strays, np.repeat(walls[:1], 30, axis=0))))


@pytest.mark.parametrize(("count", "ratio"), [(16, 3.0), (16, 0.5), (8, 1.0), (2, 0.1), (400, 1.0)])
def test_outliers_are_those_of_open3d(count: int, ratio: float) -> None:
    require_open3d()
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(room(300).numpy()))
    _, expected = cloud.remove_statistical_outlier(nb_neighbors=count, std_ratio=ratio)
    kept = remove_outliers(room(300), count, ratio)
    assert kept.tolist() == sorted(expected)
    assert 0 < len(kept) < len(room(300))


@pytest.mark.parametrize("edge", [0.003, 0.1, 1.0, 100.0])
def test_open3d_and_numpy_average_the_same_voxels(monkeypatch: pytest.MonkeyPatch, edge: float) -> None:
    require_open3d()
    points = room()
    colors = torch.rand(len(points), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with_open3d = voxel_grid(points, colors, edge)
    without_open3d(monkeypatch)
    for one, other in zip(with_open3d, voxel_grid(points, colors, edge), strict=True):
        assert one.shape == other.shape
        assert torch.allclose(one, other, rtol=0, atol=1e-9)


def test_a_stray_point_is_removed() -> None:
    # Mean distance to the 2 nearest, itself included: 1/2 four times and 96/2 once. Average 10, deviation 21.2.
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [99, 0, 0]])
    assert remove_outliers(line, 2, 1.7).tolist() == [0, 1, 2, 3]  # the limit is 46.1
    assert remove_outliers(line, 2, 1.8).tolist() == [0, 1, 2, 3, 4]  # 48.3


def test_a_point_on_its_nearest_one_is_removed() -> None:
    line = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert remove_outliers(line, 2, 3.0).tolist() == [2, 3]


def test_voxels_begin_half_an_edge_below_the_smallest_corner(monkeypatch: pytest.MonkeyPatch) -> None:
    without_open3d(monkeypatch)
    # Cubes of edge 2 from -1: [-1, 1), [1, 3).
    means = torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [2.9, 0, 0]])
    colors = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0], [0.0, 0, 1]])
    averages, shades = voxel_grid(means, colors, 2.0)
    assert torch.allclose(averages, torch.tensor([[0.45, 0, 0], [2.0, 0, 0]]))
    assert torch.allclose(shades, torch.tensor([[0.5, 0, 0], [0.0, 0.5, 0.5]]))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 60), st.floats(0.01, 10), st.integers(0, 1000))
def test_a_voxel_grid_keeps_the_cloud_in_place(n: int, edge: float, seed: int) -> None:
    """No more points than before, in the box they came from, at most one per cube."""
    means = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    with pytest.MonkeyPatch.context() as patch:
        without_open3d(patch)
        averages, _ = voxel_grid(means, means.clone(), edge)
    assert 1 <= len(averages) <= n
    assert bool((averages >= means.amin(0) - 1e-12).all() and (averages <= means.amax(0) + 1e-12).all())
    cubes = ((averages - (means.amin(0) - edge / 2)) / edge).floor()
    assert len(torch.unique(cubes, dim=0)) == len(averages)


def test_tiny_clouds_are_left_alone() -> None:
    for n in (0, 1):
        assert len(remove_outliers(torch.zeros(n, 3), 16, 3.0)) == n
        assert len(voxel_grid(torch.zeros(n, 3), torch.zeros(n, 3), 1.0)[0]) == n


def test_the_log_says_which_library_ran(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    without_open3d(monkeypatch)
    voxel_grid(room(100), room(100), 1.0)
    assert "voxels by numpy: open3d (extra [open3d]) cannot be imported" in caplog.text


def test_more_voxels_than_can_be_counted_are_refused() -> None:
    points = torch.rand(5, 3)
    with pytest.raises(ValueError, match="Enlarge the voxel"):
        voxel_grid(points, points, 1e-12)
