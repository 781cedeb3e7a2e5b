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

Products: Final[Any] = wp.types.matrix(shape=(GROUPS, 3), dtype=wp.float64)
"""⟨l, h⟩, ‖l‖², ‖h‖² of one Gaussian, a row for each group."""
COUNTS: Final = 14
Counts: Final[Any] = wp.types.vector(length=COUNTS, dtype=wp.int32)
"""Comparable and opposed Gaussians, [7] each."""


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
def compared_and_opposed(products: wp.vec3d) -> wp.vec2i:
    """Whether neither gradient is zero, and whether their cosine is below 0, too; 0 or 1."""
    zero = wp.float64(0.0)
    comparable = wp.where(products[1] > zero and products[2] > zero, 1, 0)
    return wp.vec2i(comparable, wp.where(products[0] < zero, comparable, 0))


@wp.func
def counted(p: Products) -> Counts:
    """What one Gaussian adds to the counts."""
    tally, whole = Counts(), wp.vec3d()
    for k in range(GROUPS):
        found = compared_and_opposed(p[k])
        tally[k] = found[0]
        tally[GROUPS + 1 + k] = found[1]
        whole += p[k]
    found = compared_and_opposed(whole)
    tally[GROUPS] = found[0]
    tally[2 * GROUPS + 1] = found[1]
    return tally


@wp.func
def store(p: Products, table: wp.array2d[wp.float64], i: wp.int32) -> None:
    for k in range(GROUPS):
        for c in range(3):
            table[GROUPS * c + k, i] = p[k, c]
