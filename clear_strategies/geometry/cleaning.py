"""Outliers of a cloud, as Open3D defines them."""

from __future__ import annotations

import logging
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.points import PointCloud

_log = logging.getLogger(__name__)

OUTLIER_NEIGHBOURS: Final = 16
OUTLIER_RATIO: Final = 3.0
"""The defaults of `without_outliers`' settings."""


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
