"""What several cameras look at, and cameras beside a camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import Photo
from rasterizers.interface import Camera

_PARTNERS: Final = 12  # of a photo, those that it is compared with
_NEAREST: Final = 8  # of them, those that are nearest


def common_box(photos: Sequence[Photo]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """(smallest, largest corner) of the cube around the largest ball that all cameras see whole, about what they look at."""
    cameras = [photo.camera for photo in photos]
    middle, centers = looked_at(cameras), torch.stack([c.center.double().cpu() for c in cameras])
    distance = float(torch.linalg.vector_norm(centers - middle, dim=-1).mean())
    narrowest = min(math.atan(min(c.width / c.fx, c.height / c.fy) / 2) for c in cameras)
    half = distance * math.sin(narrowest)  # the ball touches the sides of the narrowest frustum
    return (middle - half).float(), (middle + half).float()


def looked_at(cameras: Sequence[Camera]) -> Float[Tensor, " 3"]:
    """The point closest to all optical axes, float64. If these are nearly parallel, it lies ahead of the cameras, at ten times
    their largest distance from their mean.
    """
    centers = torch.stack([c.center.double().cpu() for c in cameras])
    axes = torch.stack([c.world_to_camera[2, :3].double().cpu() for c in cameras])
    extent = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()) or 1.0
    ahead = centers.mean(0) + axes.mean(0) * 10 * extent

    # Least squares over lines, Σ (I - d dᵀ)(x - c) = 0, with a weak pull to `ahead` in case they are parallel.
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    pull = 1e-3 * len(cameras)
    right = (across @ centers[:, :, None]).sum(0)[:, 0] + pull * ahead
    point: Tensor = torch.linalg.solve(across.sum(0) + pull * torch.eye(3, dtype=torch.float64), right)
    return point


def partners(cameras: Sequence[Camera]) -> list[list[int]]:
    """For each camera the others that its photo is compared with: all of few, of many the nearest and some that lie ever
    farther away.

    The nearest alone may be a burst, which shows no depth, or one side of the scene, which shows nothing of the other.
    """
    centers, others = torch.stack([camera.center.double() for camera in cameras]), len(cameras) - 1
    far = np.geomspace(_NEAREST + 1, max(others, _PARTNERS), _PARTNERS - _NEAREST).round().astype(int) - 1
    ranks = range(others) if others <= _PARTNERS else [*range(_NEAREST), *far]
    ordered = torch.cdist(centers, centers).argsort(dim=1, stable=True).tolist()
    rows = ([b for b in row if b != a] for a, row in enumerate(ordered))
    return [sorted(row[rank] for rank in ranks) for row in rows]
