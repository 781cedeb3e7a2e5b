"""Outliers and voxels: small cases by hand."""

from __future__ import annotations

import sys

import pytest
import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.geometry.cleaning import averaged_in_voxels, without_outliers
from rasterizers.interface import BackendUnavailable


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


def test_voxels_hold_the_averages_of_their_points_in_the_order_of_the_cubes():
    pytest.importorskip("open3d")
    means = torch.tensor([[0.0, 0, 0], [5.0, 0, 0], [0.2, 0.1, 0], [0.0, 5, 0]])
    cloud = averaged_in_voxels(PointCloud(means, means / 5, "given"), 1.0)
    assert torch.allclose(cloud.means, torch.tensor([[0.1, 0.05, 0], [0.0, 5, 0], [5.0, 0, 0]]))
    assert torch.allclose(cloud.colors, cloud.means / 5)
    assert cloud.source == "given, in voxels of 1"


def test_voxels_without_open3d_say_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)  # makes its import fail
    with pytest.raises(BackendUnavailable, match=r"data\.cloud\.voxel needs Open3D.*pip install .*\[open3d\]"):
        averaged_in_voxels(PointCloud(torch.rand(4, 3), torch.rand(4, 3), "given"), 0.1)
