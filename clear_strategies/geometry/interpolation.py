"""More points on the same surfaces, at inverse depths interpolated between points that are known."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.projection import (
    back_project,
    inside_of,
    is_background,
    project,
    sample_colors,
    seen_pixels,
)
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

STRIDE: Final = 2
"""LR px between the points of a grid, by default."""

_FEWEST_SAMPLES: Final = 4  # projected points from which a view's depth is interpolated
_NEARER: Final = 0.95  # a point in front of this share of another photo's depth floats in free space


def densify(cloud: PointCloud, photos: Sequence[Photo], stride: int, background: Color | None = None) -> PointCloud:
    """The cloud, with what `grid_points` adds where no depth is known."""
    means, colors = grid_points(cloud.means, photos, stride, background)
    if len(means) == 0:
        _log.warning("densify added no point.")
        return cloud
    source = f"{cloud.source}, densified by {len(means):,} at interpolated inverse depth"
    return replace(
        cloud, means=torch.cat((cloud.means, means)), colors=torch.cat((cloud.colors, colors)), source=source
    )


def grid_points(
    means: Float[Tensor, "N 3"],
    photos: Sequence[Photo],
    stride: int,
    background: Color | None = None,
    maps: Sequence[DepthMap] | None = None,
    masks: Sequence[Bool[Tensor, "h w"]] | None = None,
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """(positions, colours): in each photo a point every `stride` pixels, at inverse depth interpolated between `means`.

    Inverse depth is linear on planes. It is interpolated linearly between the projected points; outside their convex
    hull it is that of the nearest point.

    Args:
        background: pixels of this colour show no surface and get no point.
        maps: of each photo; only pixels of unknown depth get a point, unless it floats in front of the depth that another
            photo knows. None: no depth is known.
        masks: of each photo, False where it hides pixels.
    """
    added, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for i, photo in enumerate(photos):
        grid = pixel_grid(photo, stride)
        x, y = grid.long().unbind(dim=1)
        wanted = torch.ones(photo.image.shape[:2], dtype=torch.bool)
        if maps is not None:
            wanted &= ~maps[i].known.cpu()
        if masks is not None:
            wanted &= masks[i].cpu()
        grid = grid[wanted[y, x]]
        shade = sample_colors(photo.image, grid)
        if background is not None:
            surface = ~is_background(shade, background)
            grid, shade = grid[surface], shade[surface]
        inverse_depth = _interpolated(means, photo, grid, 2 * stride) if len(grid) else None
        if inverse_depth is None:
            continue
        points = back_project(photo.camera, grid, 1 / inverse_depth)
        kept = torch.ones(len(points), dtype=torch.bool)
        for j, found in enumerate(maps or ()):
            if j != i:
                kept &= ~_floats(points, photos[j], found)
        added.append(points[kept])
        colors.append(shade[kept])
    return torch.cat(added), torch.cat(colors)


def pixel_grid(photo: Photo, stride: int) -> Float[Tensor, "G 2"]:
    """The centres of the image's squares of `stride` pixels."""
    x = torch.arange(stride / 2, photo.camera.width, stride, dtype=torch.float64)
    y = torch.arange(stride / 2, photo.camera.height, stride, dtype=torch.float64)
    return torch.cartesian_prod(x, y)


def _floats(points: Float[Tensor, "N 3"], photo: Photo, found: DepthMap) -> Bool[Tensor, " N"]:
    """Whether the photo looks through the point at a surface behind it."""
    inside, row, column, depth = seen_pixels(photo.camera, points)
    inside[inside.clone()] = depth < _NEARER * found.depth.cpu()[row, column].double()
    return inside


def _interpolated(
    means: Float[Tensor, "N 3"], photo: Photo, at: Float[Tensor, "G 2"], cell: int
) -> Float[Tensor, " G"] | None:
    """Inverse depth at these pixels; None where fewer than 4 points project into the photo.

    Occluded points would distort the depth, so only the nearest point per square of `cell` pixels counts.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    pixels, depth = project(photo.camera, means)
    inside = inside_of(photo.camera, pixels, depth)
    pixels, depth = pixels[inside], depth[inside]
    order = torch.argsort(depth, stable=True)
    column, row = (pixels[order] / cell).long().unbind(dim=1)
    _, first = np.unique((row * photo.camera.width + column).numpy(), return_index=True)
    nearest = order[torch.from_numpy(first)]
    if len(nearest) < _FEWEST_SAMPLES:
        _log.warning("depth of a view cannot be interpolated: only %d points project into it.", len(nearest))
        return None
    samples, values = pixels[nearest].numpy(), (1 / depth[nearest]).numpy()
    result = np.asarray(NearestNDInterpolator(samples, values)(at.numpy()))
    try:
        linear = np.asarray(LinearNDInterpolator(samples, values)(at.numpy()))
    except QhullError:  # all samples lie on one line
        return torch.from_numpy(result)
    return torch.from_numpy(np.where(np.isfinite(linear), linear, result))
