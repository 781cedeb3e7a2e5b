"""Cleaning a cloud: outliers are removed, voxels averaged, both as Open3D defines it.

Outliers are SciPy's work, because most runs remove them and importing Open3D takes two seconds. Voxels are Open3D's where it
is installed, else numpy's; the points are the same.
"""

from __future__ import annotations

import logging
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.points import PointCloud

_log = logging.getLogger(__name__)

OUTLIER_NEIGHBOURS: Final = 16
OUTLIER_RATIO: Final = 3.0
"""The defaults of `without_outliers`' settings."""

_LARGEST_CELL: Final = np.iinfo(np.int32).max  # Open3D counts voxels along an axis in an int


def without_outliers(cloud: PointCloud, neighbours: int, ratio: float) -> PointCloud:
    """The cloud without the points that `remove_outliers` removes; all of it if `neighbours` is 0 or there are too few points.

    Args:
        neighbours: 0, or at least 2.
    """
    if neighbours == 0:
        return cloud
    if len(cloud) <= neighbours:
        _log.debug("outliers are kept: %d points are too few to tell them.", len(cloud))
        return cloud
    kept = remove_outliers(cloud.means, neighbours, ratio)
    if len(kept) == 0:
        _log.warning("outliers are kept: the points coincide, so all of them would be removed.")
        return cloud
    _log.debug("%d of %d points removed as outliers.", len(cloud) - len(kept), len(cloud))
    return cloud[kept]


def remove_outliers(means: Float[Tensor, "N 3"], neighbours: int, ratio: float) -> Int[Tensor, " K"]:
    """Indices, ascending, of the points that are no outliers.

    A point's measure is the mean distance to its `neighbours` nearest points, itself included. The point is kept if its
    measure is below the average plus `ratio` standard deviations. A point whose measure is 0, because its neighbours
    coincide with it, is removed.

    Args:
        neighbours: at least 2, because the first is the point itself. ratio: > 0.
    """
    points = means.detach().double().cpu().numpy()
    if len(points) < 2:
        return torch.arange(len(points))
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(points).query(points, k=min(neighbours, len(points)))
    measure = np.mean(distances, axis=1)
    apart = measure > 0
    # As in Open3D, coinciding points count in n, although not in the deviation's sum.
    n = len(points)
    average = measure.sum() / n
    deviation = np.sqrt(np.square(measure[apart] - average).sum() / (n - 1))
    return torch.from_numpy(np.flatnonzero(apart & (measure < average + ratio * deviation)))


def voxel_grid(
    means: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"], edge: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """One point per occupied cube: the averages of its positions and colours, ordered by cube.

    Args:
        edge: of a cube, world units, > 0. The grid starts half a cube below the smallest coordinates.

    Raises:
        ValueError: edge is so small that the number of cubes overflows.
    """
    points = means.detach().double().cpu().numpy()
    if len(points) == 0:
        return means, colors
    origin = points.min(axis=0) - edge / 2
    if float(np.ptp(points, axis=0).max()) >= edge * _LARGEST_CELL:
        raise ValueError(f"edge must be at least the cloud's extent / {_LARGEST_CELL}, got {edge}. Enlarge the voxel.")
    shades = colors.detach().double().cpu().numpy()
    open3d = _open3d()
    if open3d is not None:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.colors = open3d.utility.Vector3dVector(shades)
        merged = cloud.voxel_down_sample(edge)
        both = np.concatenate((np.asarray(merged.points), np.asarray(merged.colors)), axis=1)
        # Open3D returns the order of a hash map; here it is that of the cubes.
        both = both[np.lexsort(np.floor((both[:, 2::-1] - origin[::-1]) / edge).T)]
    else:
        cubes = np.floor((points - origin) / edge).astype(np.int64)
        order = np.lexsort(cubes.T[::-1])  # several times as fast as np.unique of rows
        owner = np.empty(len(points), np.int64)
        owner[order] = np.cumsum(np.diff(cubes[order], axis=0, prepend=cubes[order[:1]]).any(axis=1))
        columns = np.concatenate((points, shades), axis=1).T
        both = np.stack([np.bincount(owner, column) for column in columns], axis=1) / np.bincount(owner)[:, None]
    averages = torch.from_numpy(both)
    return averages[:, :3].to(means), averages[:, 3:].to(colors)


def _open3d() -> Any:
    """The module, or None where it is not installed or its system libraries are missing."""
    try:
        import open3d
    except (ImportError, OSError) as reason:
        _log.debug("voxels by numpy: open3d (extra [open3d]) cannot be imported (%s).", " ".join(str(reason).split()))
        return None
    _log.debug("voxels by open3d %s.", open3d.__version__)
    return open3d
