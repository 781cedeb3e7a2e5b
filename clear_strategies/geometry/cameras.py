"""What several cameras look at."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import Photo


def common_box(photos: Sequence[Photo]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """(smallest, largest corner) of the cube around the largest ball that all cameras see whole.

    The ball's centre is the point closest to all optical axes. If the axes are nearly parallel, it lies ahead of the
    cameras, at ten times their largest distance from their mean.
    """
    cameras = [photo.camera for photo in photos]
    centers = torch.stack([c.center.double().cpu() for c in cameras])
    axes = torch.stack([c.world_to_camera[2, :3].double().cpu() for c in cameras])
    extent = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()) or 1.0
    ahead = centers.mean(0) + axes.mean(0) * 10 * extent

    # Least squares over lines, Σ (I - d dᵀ)(x - c) = 0, with a weak pull to `ahead` in case they are parallel.
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    pull = 1e-3 * len(cameras)
    right = (across @ centers[:, :, None]).sum(0)[:, 0] + pull * ahead
    middle = torch.linalg.solve(across.sum(0) + pull * torch.eye(3, dtype=torch.float64), right)

    distance = float(torch.linalg.vector_norm(centers - middle, dim=-1).mean())
    narrowest = min(math.atan(min(c.width / c.fx, c.height / c.fy) / 2) for c in cameras)
    half = distance * math.sin(narrowest)  # the ball touches the sides of the narrowest frustum
    return (middle - half).float(), (middle + half).float()
