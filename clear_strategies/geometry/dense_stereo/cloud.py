"""Points from depth maps: one every few pixels of surface, however many photos see it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.projection import back_project, inside_of, project


def points_of(
    photos: Sequence[Photo], maps: Sequence[DepthMap], spacing: float, tolerance: float
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """(positions, colours): in each photo, the most confident pixel of each square of `spacing` pixels.

    Squares in which a point of an earlier photo lies on the surface already add none. A photo from which a surface is
    seen closer has more squares on it, so it adds points between those of photos farther away.

    Args:
        spacing: LR px, at least 1.
        tolerance: relative difference of depth up to which a point lies on the surface.
    """
    means, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for photo, found in zip(photos, maps, strict=True):
        covered = covered_squares(photo, found, torch.cat(means), spacing, tolerance)
        pixel = best_per_square(found, spacing, covered)
        row, column = pixel // photo.camera.width, pixel % photo.camera.width
        centre = torch.stack((column, row), dim=1).double() + 0.5
        means.append(back_project(photo.camera, centre, found.depth.cpu().reshape(-1)[pixel].double()))
        colors.append(photo.image.cpu().reshape(-1, 3)[pixel])
    return torch.cat(means), torch.cat(colors)


def squares_of(found: DepthMap, spacing: float) -> Int[Tensor, "h w"]:
    """The number of each pixel's square."""
    height, width = found.depth.shape
    column, row = (((torch.arange(n) + 0.5) / spacing).long() for n in (width, height))
    return row[:, None] * (int(column[-1]) + 1) + column


def covered_squares(
    photo: Photo, found: DepthMap, points: Float[Tensor, "N 3"], spacing: float, tolerance: float
) -> Bool[Tensor, " S"]:
    """Which squares hold the projection of a point that lies on the surface."""
    square = squares_of(found, spacing)
    covered = torch.zeros(int(square.max()) + 1, dtype=torch.bool)
    pixels, depth = project(photo.camera, points)
    inside = inside_of(photo.camera, pixels, depth)
    x, y = pixels[inside].long().unbind(dim=1)
    same = (found.depth.cpu()[y, x] / depth[inside] - 1).abs() <= tolerance
    covered[square[y[same], x[same]]] = True
    return covered


def best_per_square(found: DepthMap, spacing: float, covered: Bool[Tensor, " S"]) -> Int[Tensor, " K"]:
    """The pixel of highest confidence in each square that has depth and is not covered."""
    square = squares_of(found, spacing).reshape(-1)
    confidence = found.confidence.cpu().reshape(-1)
    free = torch.nonzero((confidence > 0) & ~covered[square])[:, 0]
    order = free[torch.argsort(confidence[free], descending=True, stable=True)]
    order = order[torch.argsort(square[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool)
    first[1:] = square[order[1:]] != square[order[:-1]]
    return order[first]


def shows(photo: Photo, found: DepthMap, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
    """Whether the photo has depth at the pixel of each point."""
    pixels, depth = project(photo.camera, points)
    inside = inside_of(photo.camera, pixels, depth)
    result = torch.zeros(len(points), dtype=torch.bool)
    x, y = pixels[inside].long().unbind(dim=1)
    result[inside] = found.known.cpu()[y, x]
    return result
