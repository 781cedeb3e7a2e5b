"""Functions in Warp that the reconciliation of dense gradients and the per-Gaussian step share.

Products are in float64, where no product of two floats over- or underflows. Groups are numbered as in
core.gradients.CONFLICT_GROUPS, and the whole Gaussian is a seventh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import torch
import warp as wp
from torch import Tensor

from clear_strategies.core import conflicts, deferred
from clear_strategies.kernels.reconcile.tables import WeightTable
from rasterizers.warp_runtime import struct

GROUPS: Final = wp.constant(6)
MEANS: Final = wp.constant(0)
SH0: Final = wp.constant(1)
SHN: Final = wp.constant(2)
OPACITIES: Final = wp.constant(3)
SCALES: Final = wp.constant(4)
QUATS: Final = wp.constant(5)

Six: Final[Any] = wp.types.vector(length=6, dtype=wp.float64)
COUNTS: Final = 14
Counts: Final[Any] = wp.types.vector(length=COUNTS, dtype=wp.int32)
"""Comparable and opposed Gaussians, [7] each."""


@wp.struct
class Products:
    """⟨l, h⟩, ‖l‖², ‖h‖² by group."""

    dot: Six
    l2: Six
    h2: Six


@wp.struct
class Weight:
    """A weight of each Gaussian and group."""

    number: wp.float64  # of all, where there are no rows
    rows: wp.array[wp.float64]
    stride: wp.int32  # from one group to the next
    has_rows: wp.bool


@wp.struct
class Weights:
    """ĝ_HR = keep · g_HR - remove · g_LR."""

    keep: Weight
    remove: Weight


def weights_of(tables: Sequence[WeightTable]) -> Any:
    """The weights as kernels take them."""
    keep, remove = (
        struct(Weight, {"rows": rows}, number=number, stride=stride, has_rows=rows is not None)
        for number, rows, stride in tables
    )
    return struct(Weights, {}, keep=keep, remove=remove)


def product_table(like: Tensor, n: int, blocks: int) -> tuple[Tensor, Tensor]:
    """What a kernel writes products and counts to, [18, N] and [blocks, 14]."""
    return like.new_empty(18, n, dtype=torch.float64), like.new_empty(blocks, COUNTS, dtype=torch.int32)


def products_of(names: Sequence[str], table: Tensor, counts: Tensor) -> conflicts.Products:
    """What the kernel has written."""
    sums = deferred.elements(counts.sum(0))
    dot, l2, h2 = (x.T for x in table.view(3, int(GROUPS), -1))
    return conflicts.Products(names, dot, l2, h2, sums[:7], sums[7:])


@wp.func
def weight(w: Weight, group: wp.int32, i: wp.int32) -> wp.float64:
    if w.has_rows:
        return w.rows[group * w.stride + i]
    return w.number


@wp.func
def reconciled(high: wp.float32, low: wp.float32, keep: wp.float64, remove: wp.float64) -> wp.float32:
    """ĝ_HR (Eq. 7), with the bits of g_HR where keep is 1 and remove is 0."""
    return wp.float32(wp.float64(high) * keep - wp.float64(low) * remove)


@wp.func
def counted(p: Products) -> Counts:
    """What one Gaussian adds to the counts."""
    tally, zero, dot, l2, h2 = Counts(), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for k in range(GROUPS):
        comparable = wp.where(p.l2[k] > zero and p.h2[k] > zero, 1, 0)
        tally[k] = comparable
        tally[GROUPS + 1 + k] = wp.where(p.dot[k] < zero, comparable, 0)
        dot += p.dot[k]
        l2 += p.l2[k]
        h2 += p.h2[k]
    whole = wp.where(l2 > zero and h2 > zero, 1, 0)
    tally[GROUPS] = whole
    tally[2 * GROUPS + 1] = wp.where(dot < zero, whole, 0)
    return tally


@wp.func
def store(p: Products, table: wp.array2d[wp.float64], i: wp.int32) -> None:
    for k in range(GROUPS):
        table[k, i] = p.dot[k]
        table[GROUPS + k, i] = p.l2[k]
        table[2 * GROUPS + k, i] = p.h2[k]
