"""The memory layout of gradients and weights for the compiled passes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor

from clear_strategies.core.conflicts import Weights
from clear_strategies.core.gradients import CONFLICT_GROUPS, Colour, Grads

WIDEST: Final = 45
"""The most numbers of a Gaussian in one attribute: the higher bands of three degrees of spherical harmonics."""

FIRST_BANDS: Final = {"sh0": 0, "shN": 1}
"""The first band of the attributes that are spherical harmonics."""


def has(g: Grads, name: str) -> bool:
    """Return True if there is a gradient of the attribute, by name or as factors."""
    return name in g or (g.colour is not None and name in FIRST_BANDS)


def common_groups(lr: Grads, hr: Grads) -> Sequence[str]:
    """The groups that both gradients have."""
    return [group for group in CONFLICT_GROUPS if has(lr, group) and has(hr, group)]


def contiguous(g: Grads) -> Grads:
    """The same gradient in the layout that kernels take."""
    colour = None if g.colour is None else Colour(*(x.contiguous() for x in g.colour))
    return Grads({name: x.contiguous() for name, x in g.items()}, colour=colour)


def row_width(name: str, *gradients: Grads) -> int:
    """The numbers of a row of an attribute that one of the gradients has."""
    for g in gradients:
        if name in g:
            return g[name].shape[1:].numel()
    bases = max(g.colour.basis.shape[1] for g in gradients if g.colour is not None)
    return 3 if name == "sh0" else 3 * (bases - 1)


WeightTable = tuple[float, Tensor | None, int]
"""A weight as the kernels take it: a number, float64 rows that replace it, and the stride from one group to the next."""


def weight_tables(weights: Weights, n: int, device: torch.device) -> tuple[WeightTable, ...]:
    """The tables of keep and remove, of n Gaussians."""
    return tuple(_table(name, weight, n, device) for name, weight in zip(Weights._fields, weights, strict=True))


def addresses(tables: Sequence[WeightTable]) -> tuple[tuple[float, int, int], ...]:
    """The tables as the C++ kernels take them; the caller keeps the rows alive."""
    return tuple((number, 0 if rows is None else rows.data_ptr(), stride) for number, rows, stride in tables)


def _table(name: str, weight: float | Tensor, n: int, device: torch.device) -> WeightTable:
    if not isinstance(weight, Tensor):
        return float(weight), None, 0
    groups = len(CONFLICT_GROUPS)
    if weight.shape not in ((), (n,), (n, groups)) or weight.device != device:
        raise ValueError(
            f"Weights.{name} must be a number, or a tensor [{n}] or [{n}, {groups}] on {device}, got {list(weight.shape)} on "
            f"{weight.device}."
        )
    rows = weight.expand(n) if weight.dim() == 0 else weight.T if weight.dim() == 2 else weight
    return 0.0, rows.to(torch.float64).contiguous(), n if weight.dim() == 2 else 0
