"""Which cameras see a surface, and which points lie on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.geometry.projection import inside_of, project, seen_pixels
from rasterizers.interface import Camera

_TOLERANCE: Final = 0.03  # a camera sees a point whose depth there exceeds the camera's own by at most this share of it


def times_seen(
    points: Float[Tensor, "N 3"], cameras: Sequence[tuple[Camera, Float[Tensor, "h w"]]]
) -> Int[Tensor, " N"]:
    """In how many cameras, each with its depth (nan without a surface), each point is inside the image and not hidden."""
    count = torch.zeros(len(points), dtype=torch.long)
    for camera, depth in cameras:
        inside, row, column, z = seen_pixels(camera, points)
        count[inside] += z <= depth[row, column] * (1 + _TOLERANCE)
    return count


def on_surface(
    camera: Camera, depth: Float[Tensor, "h w"], points: Float[Tensor, "N 3"], tolerance: float
) -> tuple[Bool[Tensor, " N"], Float[Tensor, "N 2"]]:
    """(whether each point's depth differs from `depth`, nan or 0 where it is unknown, by at most `tolerance`, relatively; the
    pixels that the points project to).
    """
    pixels, z = project(camera, points)
    inside = inside_of(camera, pixels, z)
    column, row = torch.where(inside[:, None], pixels, 0.0).long().unbind(dim=1)
    return inside & ((depth[row, column] / z - 1).abs() <= tolerance), pixels
