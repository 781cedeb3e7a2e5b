"""Points where stereo found no depth, at interpolated inverse depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.interpolation import interpolate_depth, pixel_grid
from clear_strategies.geometry.projection import back_project, is_background, sample_colors, seen_pixels
from rasterizers.interface import Color

STRIDE: Final = 2
"""LR px between the points of the grid, by default."""

_NEARER: Final = 0.95  # a filled point in front of this share of another photo's depth floats in free space


def fill(
    means: Float[Tensor, "N 3"],
    photos: Sequence[Photo],
    maps: Sequence[DepthMap],
    stride: int,
    background: Color | None = None,
    masks: Sequence[Bool[Tensor, "h w"]] | None = None,
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """(positions, colours) of a grid of `stride` px over the unknown parts of each photo.

    A point is left out if it floats in front of the depth that another photo knows.

    Args:
        means: the points between which inverse depth is interpolated.
        background: the colour of pixels without a surface.
        masks: of each photo, False where it hides pixels.
    """
    added, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for i, (photo, found) in enumerate(zip(photos, maps, strict=True)):
        grid = pixel_grid(photo, stride)
        x, y = grid.long().unbind(dim=1)
        unknown = ~found.known.cpu()
        if masks is not None:
            unknown &= masks[i].cpu()
        grid = grid[unknown[y, x]]
        shade = sample_colors(photo.image, grid)
        if background is not None:
            surface = ~is_background(shade, background)
            grid, shade = grid[surface], shade[surface]
        inverse_depth = interpolate_depth(means, photo, grid, 2 * stride) if len(grid) else None
        if inverse_depth is None:
            continue
        points = back_project(photo.camera, grid, 1 / inverse_depth)
        kept = torch.ones(len(points), dtype=torch.bool)
        for j, (other, known) in enumerate(zip(photos, maps, strict=True)):
            if j != i:
                kept &= ~floats(points, other, known)
        added.append(points[kept])
        colors.append(shade[kept])
    return torch.cat(added), torch.cat(colors)


def floats(points: Float[Tensor, "N 3"], photo: Photo, found: DepthMap) -> Bool[Tensor, " N"]:
    """Whether the photo looks through the point at a surface behind it."""
    inside, row, column, depth = seen_pixels(photo.camera, points)
    inside[inside.clone()] = depth < _NEARER * found.depth.cpu()[row, column].double()
    return inside
