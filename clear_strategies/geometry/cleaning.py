"""Removal of a cloud's outliers, as Open3D defines them, and averaging in voxels by Open3D.

Outliers are removed by SciPy, because most runs remove them and importing Open3D takes two seconds.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from clear_strategies.core.points import PointCloud
from rasterizers.interface import BackendUnavailable
from rasterizers.native import threads

_log = logging.getLogger(__name__)

OUTLIER_NEIGHBOURS: Final = 16
OUTLIER_RATIO: Final = 3.0
"""The defaults of `without_outliers`' settings."""


def without_outliers(cloud: PointCloud, neighbours: int, ratio: float) -> PointCloud:
    """Remove outliers; none if `neighbours` is 0 or there are too few points.

    A point's measure is the mean distance to its `neighbours` nearest points (2 or more), itself included. The point is kept if
    its measure is below the average plus `ratio` standard deviations. A point whose measure is 0, because its neighbours
    coincide with it, is removed.
    """
    n = len(cloud)
    if neighbours == 0 or n <= neighbours:
        return cloud
    from scipy.spatial import cKDTree

    points = cloud.means.detach().double().cpu().numpy()
    measure = np.mean(cKDTree(points).query(points, k=neighbours, workers=threads())[0], axis=1)
    apart = measure > 0
    # As in Open3D, coinciding points count in n, although not in the deviation's sum.
    average = measure.sum() / n
    deviation = np.sqrt(np.square(measure[apart] - average).sum() / (n - 1))
    kept = np.flatnonzero(apart & (measure < average + ratio * deviation))
    if len(kept) == 0:
        _log.warning("outliers are kept: the points coincide, so all of them would be removed.")
        return cloud
    return cloud[torch.from_numpy(kept)]


def averaged_in_voxels(cloud: PointCloud, edge: float) -> PointCloud:
    """Replace the points in each cube of this edge (world units) by one with their mean position and colour, ordered by cube. The
    grid starts half a cube below the smallest coordinates.

    Raises:
        BackendUnavailable: Open3D is not installed, or a library of the system that it needs.
    """
    try:
        import open3d
    except (ImportError, OSError) as reason:
        raise BackendUnavailable(
            f"data.cloud.voxel needs Open3D, which cannot be imported ({' '.join(str(reason).split())}); "
            "pip install 'clear-strategies[open3d]', or leave voxel out."
        ) from reason
    points = cloud.means.detach().double().cpu().numpy()
    given = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    given.colors = open3d.utility.Vector3dVector(cloud.colors.detach().double().cpu().numpy())
    merged = given.voxel_down_sample(edge)
    means, colors = np.asarray(merged.points), np.asarray(merged.colors)
    # Open3D returns the order of a hash map; here it is that of the cubes.
    order = np.lexsort(np.floor((means[:, ::-1] - points.min(axis=0)[::-1] + edge / 2) / edge).T)
    return replace(
        cloud, means=torch.from_numpy(means[order]).to(cloud.means), colors=torch.from_numpy(colors[order]).to(cloud.colors),
        source=f"{cloud.source}, in voxels of {edge:g}",
    )  # fmt: skip
