"""Which cameras see a surface, and which points lie on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.geometry.projection import back_project, inside_of, project, seen_pixels
from rasterizers.interface import Camera

_TOLERANCE: Final = 0.03  # a camera sees a point whose depth there exceeds the camera's own by at most this share of it


def seen_by(
    camera: Camera, depth: Float[Tensor, "H W"], others: Sequence[tuple[Camera, Float[Tensor, "h w"]]]
) -> Int[Tensor, "H W"]:
    """In how many other cameras the surface behind each pixel is inside the image and not hidden.

    Args:
        depth: z in world units, nan where there is no surface; the count is 0 there.
        others: cameras, each with its own depth.
    """
    rows, columns = torch.nonzero(depth.isfinite(), as_tuple=True)
    surface = back_project(camera, torch.stack((columns, rows), dim=1) + 0.5, depth[rows, columns])
    seen = torch.zeros(depth.shape, dtype=torch.long)
    seen[rows, columns] = times_seen(surface, others)
    return seen


def times_seen(
    points: Float[Tensor, "N 3"], cameras: Sequence[tuple[Camera, Float[Tensor, "h w"]]]
) -> Int[Tensor, " N"]:
    """In how many cameras each point is inside the image and not hidden.

    Args:
        cameras: each with its depth, nan where there is no surface, so that no point is seen there.
    """
    count = torch.zeros(len(points), dtype=torch.long)
    for camera, depth in cameras:
        inside, row, column, z = seen_pixels(camera, points)
        count[inside] += z <= depth[row, column] * (1 + _TOLERANCE)
    return count


def on_surface(
    camera: Camera, depth: Float[Tensor, "h w"], points: Float[Tensor, "N 3"], tolerance: float
) -> tuple[Bool[Tensor, " N"], Float[Tensor, "N 2"]]:
    """(whether each point lies on the surface at the pixel that it projects to, these pixels).

    Args:
        depth: of the camera, nan or 0 where it is unknown, so that no point lies there.
        tolerance: relative difference of depth up to which a point lies on the surface.
    """
    pixels, z = project(camera, points)
    inside = inside_of(camera, pixels, z)
    column, row = torch.where(inside[:, None], pixels, 0.0).long().unbind(dim=1)
    return inside & ((depth[row, column] / z - 1).abs() <= tolerance), pixels
