"""Semi-global smoothing of a cost volume (Hirschmüller 2008): the sum of eight one-dimensional minimisations.

Along each path, L(p, d) = C(p, d) + min(L(q, d), L(q, d ± 1) + P1, min L(q) + P2) - min L(q), where q is the pixel before p
and P2 falls with the difference of their grey values.
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels import native

_EDGE: Final = 20.0  # P2 is halved where neighbours differ by 1 / _EDGE in grey
_FAR: Final = 1e9  # cost of planes before the first and after the last


def smooth(
    cost: Float[Tensor, "H W D"], image: Float[Tensor, "H W"], small_step: float, large_step: float
) -> Float[Tensor, "H W D"]:
    """The mean over eight directions of L; `small_step` is P1, `large_step` the largest P2, and `image` grey in [0, 1]."""
    total = torch.zeros_like(cost, memory_format=torch.contiguous_format)
    if native.runs(cost):
        native.module().add_paths(cost.contiguous(), image.contiguous(), small_step, large_step, total)
        return total.mul_(1 / 8)
    for turned, shifts in ((False, (-1, 0, 1)), (True, (0,))):
        C, grey, rows = (x.transpose(0, 1) if turned else x for x in (cost, image, total))
        _scan(C, grey, list(rows.unbind()), shifts, small_step, large_step)
        _scan(C.flip(0), grey.flip(0), list(reversed(rows.unbind())), shifts, small_step, large_step)
    return total.mul_(1 / 8)


def _scan(
    cost: Float[Tensor, "H W D"],
    image: Float[Tensor, "H W"],
    rows: list[Tensor],
    shifts: tuple[int, ...],
    small_step: float,
    large_step: float,
) -> None:
    """Add L of the paths from the row before, offset by `shifts` columns, to the rows of the sum."""
    height, width, planes = cost.shape
    # A column of zeros at both sides: paths that enter there start with L = C.
    before = cost.new_zeros(len(shifts), width + 2, planes + 2)
    before[..., 0] = before[..., -1] = _FAR
    neighbour = [slice(1 + s, 1 + s + width) for s in shifts]
    for y in range(height):
        last = torch.stack([before[k, columns] for k, columns in enumerate(neighbour)])
        here = last[..., 1:-1]
        lowest = here.amin(dim=-1, keepdim=True)
        limit = lowest + _jump(image, y, shifts, small_step, large_step)
        step = torch.minimum(last[..., :-2], last[..., 2:]).add_(small_step)
        step = torch.minimum(torch.minimum(step, here, out=step), limit, out=step)
        step.sub_(lowest).add_(cost[y])
        before[:, 1:-1, 1:-1] = step
        for path in step:
            rows[y] += path


def _jump(
    image: Float[Tensor, "H W"], y: int, shifts: tuple[int, ...], small_step: float, large_step: float
) -> Float[Tensor, "S W 1"]:
    """P2 of row y, at least P1."""
    previous = torch.nn.functional.pad(image[max(y - 1, 0)][None], (1, 1), mode="replicate")[0]
    width = image.shape[1]
    difference = torch.stack([(image[y] - previous[1 + s : 1 + s + width]).abs() for s in shifts])
    return (large_step / (1 + _EDGE * difference)).clamp_min(small_step)[..., None]
