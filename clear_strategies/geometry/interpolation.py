"""Densification: more points on the same surfaces, at inverse depths interpolated between the points of a cloud."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import Photo
from clear_strategies.geometry.projection import back_project, is_background, project, sample_colors
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_FEWEST_SAMPLES: Final = 4  # projected points from which a view's depth is interpolated


def densify(cloud: PointCloud, photos: Sequence[Photo], stride: int, background: Color | None = None) -> PointCloud:
    """Add, per view, a point every `stride` pixels at the interpolated inverse depth of the cloud.

    Inverse depth is linear on planes. It is interpolated linearly between the projected points; outside their convex
    hull it is that of the nearest point. Pixels of the background's colour show no surface and get no point.
    """
    means, colors = [cloud.means], [cloud.colors]
    for i, photo in enumerate(photos):
        grid = pixel_grid(photo, stride)
        grid_colors = sample_colors(photo.image, grid)
        if background is not None:
            surface = ~is_background(grid_colors, background)
            grid, grid_colors = grid[surface], grid_colors[surface]
        inverse_depth = interpolate_depth(cloud.means, photo, grid, 2 * stride)
        if inverse_depth is None:
            _log.warning("view %d is not densified.", i)
            continue
        means.append(back_project(photo.camera, grid, 1 / inverse_depth))
        colors.append(grid_colors)
    added = sum(map(len, means[1:]))
    if added == 0:
        _log.warning("densify added no point.")
        return cloud
    source = f"{cloud.source}, densified by {added:,} at interpolated inverse depth"
    return replace(cloud, means=torch.cat(means), colors=torch.cat(colors), source=source)


def interpolate_depth(
    means: Float[Tensor, "N 3"], photo: Photo, at: Float[Tensor, "G 2"], cell: int
) -> Float[Tensor, " G"] | None:
    """Inverse depth at these pixels, between the nearest points per square of `cell` pixels; None: fewer than 4 points."""
    pixels, inverse_depth = _samples(means, photo, cell)
    if len(pixels) < _FEWEST_SAMPLES:
        _log.warning("depth of a view cannot be interpolated: only %d points project into it.", len(pixels))
        return None
    return _interpolate(pixels, inverse_depth, at)


def pixel_grid(photo: Photo, stride: int) -> Float[Tensor, "G 2"]:
    """The centres of the image's squares of `stride` pixels."""
    x = torch.arange(stride / 2, photo.camera.width, stride, dtype=torch.float64)
    y = torch.arange(stride / 2, photo.camera.height, stride, dtype=torch.float64)
    return torch.cartesian_prod(x, y)


def _samples(
    means: Float[Tensor, "N 3"], photo: Photo, cell: int
) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, " V"]]:
    """(pixels, inverse depths) of the points that project into the photo, the nearest one per square of `cell` pixels.

    Tracks, which list the points that a view observes, are not always known. Occluded points would distort the depth,
    so only the nearest point in each square is kept.
    """
    camera = photo.camera
    pixels, depth = project(camera, means)
    size = torch.tensor([camera.width, camera.height])
    inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    pixels, depth = pixels[inside], depth[inside]
    order = torch.argsort(depth, stable=True)
    column, row = (pixels[order] / cell).long().unbind(dim=1)
    _, first = np.unique((row * camera.width + column).numpy(), return_index=True)
    kept = order[torch.from_numpy(first)]
    return pixels[kept].numpy(), (1 / depth[kept]).numpy()


def _interpolate(
    pixels: Float[np.ndarray, "V 2"], values: Float[np.ndarray, " V"], at: Float[Tensor, "G 2"]
) -> Float[Tensor, " G"]:
    """Linear between the samples, the nearest sample's value outside their convex hull."""
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    result = np.asarray(NearestNDInterpolator(pixels, values)(at.numpy()))
    try:
        linear = np.asarray(LinearNDInterpolator(pixels, values)(at.numpy()))
    except QhullError:  # all samples lie on one line
        return torch.from_numpy(result)
    return torch.from_numpy(np.where(np.isfinite(linear), linear, result))
