"""Which depths other photos confirm."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.geometry.dense_stereo.depth import Estimate
from clear_strategies.geometry.dense_stereo.settings import StereoSettings


def confirm(
    mine: Estimate, others: Sequence[Estimate], settings: StereoSettings
) -> tuple[Int[Tensor, "H W"], Float[Tensor, "H W"]]:
    """(how many of the others agree at each pixel, mean inverse depth of all that agree, the photo's own included).

    Each pixel's point is looked up in the depth of the others, and the point found there is brought back.
    Another photo agrees if that depth differs by at most `tolerance`, relatively, and if the point comes back to within
    `reprojection` pixels.
    """
    height, width = mine.inverse_depth.shape
    agreeing = torch.zeros(height, width, dtype=torch.long, device=mine.inverse_depth.device)
    total = mine.inverse_depth.double()
    column = torch.arange(width, device=total.device) + 0.5
    row = (torch.arange(height, device=total.device) + 0.5)[:, None]
    for other in others:
        u, v, depth, seen = carry(mine, other, mine.inverse_depth)
        x, y = u.long(), v.long()
        found = other.inverse_depth[y, x]
        u, v, back, ahead = carry(other, mine, found, (y, x))
        same = (depth * found - 1).abs() <= settings.tolerance
        near = (u - column).square() + (v - row).square() <= settings.reprojection**2
        agrees = seen & ahead & same & near
        agreeing += agrees
        total = total + torch.where(agrees, 1 / back.double(), 0.0)
    return agreeing, (total / (agreeing + 1)).float()


def carry(
    mine: Estimate,
    other: Estimate,
    inverse_depth: Float[Tensor, "H W"],
    at: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(column, row, depth, whether inside) in the other photo of the points at these inverse depths.

    Columns and rows are in pixels and clamped into the other photo.

    Args:
        at: (rows, columns) of the pixels; None: every pixel.
    """
    rotated, shift = mine.image.towards(other.image)
    if at is not None:
        rotated = rotated[at]
    x, y, z = (rotated[..., k] + shift[k] * inverse_depth for k in range(3))
    height, width = other.inverse_depth.shape
    ahead = (z > 0) & (inverse_depth > 0)
    u, v = x / z, y / z
    seen = ahead & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    depth = torch.where(ahead, z / inverse_depth, torch.inf)
    u, v = (torch.where(ahead, c, 0.0).clamp(0, size - 1e-3) for c, size in ((u, width), (v, height)))
    return u, v, depth, seen
