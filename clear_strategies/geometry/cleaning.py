"""Removal of a cloud's outliers and averaging in voxels, as Open3D defines them."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from clear_strategies.core.points import PointCloud
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
    grid starts half a cube below the smallest coordinates, as Open3D's.
    """
    points, colors = (x.detach().double().cpu().numpy() for x in (cloud.means, cloud.colors))
    _, cube = np.unique(np.floor((points - (points.min(axis=0) - edge / 2)) / edge), axis=0, return_inverse=True)
    cube = cube.ravel()  # NumPy 2.0 alone returns [N, 1]
    means, colors = (
        np.stack([np.bincount(cube, column) for column in rows.T], axis=1) / np.bincount(cube)[:, None]
        for rows in (points, colors)
    )
    return replace(
        cloud, means=torch.from_numpy(means).to(cloud.means), colors=torch.from_numpy(colors).to(cloud.colors),
        source=f"{cloud.source}, in voxels of {edge:g}",
    )  # fmt: skip
