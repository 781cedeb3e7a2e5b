"""Points from depth maps: one per few pixels of surface, independent of the number of photos that see it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.cleaning import OUTLIER_NEIGHBOURS, OUTLIER_RATIO, without_outliers
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.filling import STRIDE, grid_points
from clear_strategies.geometry.optional import REMEDY, missing
from clear_strategies.geometry.projection import back_project, seen_pixels
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_LISTED: Final = 12  # photos of which each coverage is told


def stereo_cloud(
    features: PointCloud,
    photos: Sequence[Photo],
    maps: Sequence[DepthMap],
    settings: StereoSettings,
    *,
    background: Color | None = None,
    fill: bool = True,
    stride: int = STRIDE,
    outlier_neighbours: int = OUTLIER_NEIGHBOURS,
    outlier_ratio: float = OUTLIER_RATIO,
) -> PointCloud | None:
    """Make a cloud of the depth maps, with features where depth is unknown and points that fill the rest; None: no known depth.

    Without SciPy no outlier is removed and nothing is filled; the log and the cloud's `source` say so.

    Args:
        features: points of the surfaces, e.g. triangulated ones; there may be none.
        background: the colour of pixels without a surface.
        fill: add a grid of `stride` px at completed depth where a photo's depth is unknown.
        outlier_neighbours, outlier_ratio: see `without_outliers`.
    """
    if not any(depth_map.coverage > 0 for depth_map in maps):
        return None
    means, colors = points_of(photos, maps, settings.spacing, settings.tolerance)
    known = torch.zeros(len(features), dtype=torch.bool)
    for photo, depth_map in zip(photos, maps, strict=True):
        inside, row, column, _ = seen_pixels(photo.camera, features.means)
        known[inside] |= depth_map.known.cpu()[row, column]
    means = torch.cat((means, features.means[~known]))
    colors = torch.cat((colors, features.colors[~known]))
    shares = [depth_map.coverage for depth_map in maps]
    told = ", ".join(f"{share:.0%}" for share in shares)
    if len(shares) > _LISTED:
        told = f"{min(shares):.0%} to {max(shares):.0%}, on average {sum(shares) / len(shares):.0%}"
    uncovered = sum(share == 0 for share in shares)
    source = f"{len(means):,} points of dense stereo between the {len(photos)} photos (depth known at {told})"
    if (fill or outlier_neighbours) and (packages := missing("scipy")):
        _log.warning("no outlier is removed and nothing is filled without %s: %s", packages, REMEDY)
        return PointCloud(means, colors, f"{source}, neither cleaned nor filled without {packages}")
    if uncovered and fill:
        source += f", {uncovered} of them completed alone"
    cloud = without_outliers(PointCloud(means, colors, source), outlier_neighbours, outlier_ratio)
    if not fill:
        return cloud
    added, shades = grid_points(cloud.means, photos, stride, background, maps)
    source += f", less {len(means) - len(cloud.means):,} outliers, and {len(added):,} at completed depth"
    return PointCloud(torch.cat((cloud.means, added)), torch.cat((cloud.colors, shades)), source)


def points_of(
    photos: Sequence[Photo], maps: Sequence[DepthMap], spacing: float, tolerance: float
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """(positions, colours) of the most confident pixel in each square of `spacing` pixels of each photo.

    A square adds no point if one of an earlier photo already lies on the surface there. A photo closer to the surface has more
    squares on it, so it adds points between those of photos farther away.

    Args:
        spacing: LR px, at least 1.
        tolerance: relative difference of depth up to which a point lies on the surface.
    """
    means, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for photo, depth_map in zip(photos, maps, strict=True):
        pixel = _best_per_square(photo, depth_map, torch.cat(means), spacing, tolerance)
        row, column = pixel // photo.camera.width, pixel % photo.camera.width
        centre = torch.stack((column, row), dim=1).double() + 0.5
        means.append(back_project(photo.camera, centre, depth_map.depth.cpu().reshape(-1)[pixel].double()))
        colors.append(photo.image.cpu().reshape(-1, 3)[pixel])
    return torch.cat(means), torch.cat(colors)


def _best_per_square(
    photo: Photo, depth_map: DepthMap, points: Float[Tensor, "N 3"], spacing: float, tolerance: float
) -> Int[Tensor, " K"]:
    """The pixel of highest confidence in each square that has depth, unless a point on the surface projects into it."""
    height, width = depth_map.depth.shape
    x, y = (((torch.arange(n) + 0.5) / spacing).long() for n in (width, height))
    squares = y[:, None] * (int(x[-1]) + 1) + x
    covered = torch.zeros(int(squares.max()) + 1, dtype=torch.bool)
    _, row, column, depth = seen_pixels(photo.camera, points)
    same = (depth_map.depth.cpu()[row, column] / depth - 1).abs() <= tolerance
    covered[squares[row[same], column[same]]] = True
    square, confidence = squares.reshape(-1), depth_map.confidence.cpu().reshape(-1)
    free = torch.nonzero((confidence > 0) & ~covered[square])[:, 0]
    order = free[torch.argsort(confidence[free], descending=True, stable=True)]
    _, first = np.unique(square[order].numpy(), return_index=True)
    return order[torch.from_numpy(first)]
