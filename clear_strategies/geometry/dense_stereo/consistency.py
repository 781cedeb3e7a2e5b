"""Consistency of depth: confirmation by other photos, and detection of isolated depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.geometry.dense_stereo.cost import Grey
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.optional import missing
from clear_strategies.geometry.projection import inside


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The depth of one photo, before the check against other photos."""

    image: Grey
    inverse_depth: Float[Tensor, "H W"]  # 1 / z, 1 / world units
    correlation: Float[Tensor, "H W"]  # ZNCC of the windows at that depth, in [-1, 1]


def confirm(
    estimate: Estimate, others: Sequence[Estimate], settings: StereoSettings
) -> tuple[Int[Tensor, "H W"], Int[Tensor, "H W"], Float[Tensor, "H W"]]:
    """(number of others that agree at each pixel, number of others whose frame contains its point, mean inverse depth over those
    that agree and the photo itself).

    Each pixel's point is projected into the others, and the point at their depth there is projected back. A photo agrees if the
    relative difference of the depths is at most `tolerance`, and the distance from the pixel at most `reprojection` pixels.
    """
    height, width = estimate.inverse_depth.shape
    agreeing = torch.zeros(height, width, dtype=torch.long, device=estimate.inverse_depth.device)
    seeing = torch.zeros_like(agreeing)
    total = estimate.inverse_depth.double()
    column = torch.arange(width, device=total.device) + 0.5
    row = (torch.arange(height, device=total.device) + 0.5)[:, None]
    for other in others:
        u, v, depth, seen = reproject(estimate, other, estimate.inverse_depth)
        x, y = u.long(), v.long()
        other_inverse = other.inverse_depth[y, x]
        u, v, back, ahead = reproject(other, estimate, other_inverse, (y, x))
        same = (depth * other_inverse - 1).abs() <= settings.tolerance
        near = (u - column).square() + (v - row).square() <= settings.reprojection**2
        agrees = seen & ahead & same & near
        agreeing += agrees
        seeing += seen
        total = total + torch.where(agrees, 1 / back.double(), 0.0)
    return agreeing, seeing, (total / (agreeing + 1)).float()


def reproject(
    estimate: Estimate, other: Estimate, inverse_depth: Float[Tensor, "H W"], at: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project the points at these inverse depths, behind every pixel or those `at` (rows, columns), into the other photo.

    Returns:
        (column, row, depth, inside): columns and rows in pixels, clamped into the photo; `inside` is False for those clamped.
    """
    rotated, shift = estimate.image.towards(other.image)
    if at is not None:
        rotated = rotated[at]
    x, y, z = (rotated[..., k] + shift[k] * inverse_depth for k in range(3))
    height, width = other.inverse_depth.shape
    ahead = (z > 0) & (inverse_depth > 0)
    u, v = x / z, y / z
    seen = ahead & inside(u, v, z, width, height)
    depth = torch.where(ahead, z / inverse_depth, torch.inf)
    u, v = (torch.where(ahead, c, 0.0).clamp(0, size - 1e-3) for c, size in ((u, width), (v, height)))
    return u, v, depth, seen


def speckles(depth: Float[Tensor, "h w"], fewest: int, tolerance: float) -> Bool[Tensor, "h w"]:
    """Find known depth in groups of fewer than `fewest` connected pixels: mostly chance matches. All False without SciPy.

    Two pixels are connected if they share an edge and their depths, NaN where unknown, differ relatively by at most `tolerance`.
    """
    if fewest <= 1 or missing("scipy"):
        return torch.zeros_like(depth, dtype=torch.bool)
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    values = depth.double().cpu().numpy()
    pixel = np.arange(values.size).reshape(values.shape)
    edges = []
    for left, right in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        alike = np.abs(values[left] / values[right] - 1) <= tolerance  # False beside NaN
        edges.append((pixel[left][alike], pixel[right][alike]))
    rows, columns = (np.concatenate(ends) for ends in zip(*edges, strict=True))
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(values.size, values.size))
    _, island = connected_components(graph, directed=False)
    small = (np.bincount(island)[island] < fewest).reshape(values.shape)
    return (torch.from_numpy(small) & depth.cpu().isfinite()).to(depth.device)
