"""Products and apply in Warp, for CUDA; tests also run the kernels on a CPU. Counts stay on the device.

`compare` has one thread per Gaussian, `combine` one per number, so that neighbouring threads write neighbouring memory. Products
are in float64, where no product of two floats over- or underflows. `kernels.gaussian_step.warp` shares the first half of this
file. Importing it imports Warp; call `rasterizers.warp_runtime.require_warp` first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import torch
import warp as wp
from torch import Tensor

from clear_strategies.core import conflicts, deferred
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.kernels.reconcile.tables import FIRST_BANDS, WeightTable, contiguous, row_width, weight_tables
from rasterizers.warp_runtime import lanes_on, launch, struct

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LANES: Final = 128  # threads per block, see `lanes_on`
_ORDER: Final = ("means", "quats", "scales", "opacities", "sh0", "shN", "detail")


GROUPS: Final = wp.constant(len(CONFLICT_GROUPS))
MEANS, SH0, SHN, OPACITIES, SCALES, QUATS = map(wp.constant, range(GROUPS))  # as in CONFLICT_GROUPS

Products: Final[Any] = wp.types.matrix(shape=(GROUPS, 3), dtype=wp.float64)
"""⟨l, h⟩, ‖l‖², ‖h‖² of one Gaussian, a row for each group."""
COUNTS: Final = 14
Counts: Final[Any] = wp.types.vector(length=COUNTS, dtype=wp.int32)
"""Comparable and opposed Gaussians, [7] each: of the groups, and of the whole Gaussian."""


@wp.struct
class Weight:
    """A weight of each Gaussian and group."""

    number: wp.float64  # of all, where there are no rows
    rows: wp.array[wp.float64]
    stride: wp.int32  # from one group to the next


@wp.struct
class Weights:
    """ĝ_HR = keep · g_HR - remove · g_LR."""

    keep: Weight
    remove: Weight


def weights_of(tables: Sequence[WeightTable]) -> Any:
    """The weights as kernels take them."""
    keep, remove = (struct(Weight, rows=rows, number=number, stride=stride) for number, rows, stride in tables)
    return struct(Weights, keep=keep, remove=remove)


def product_table(like: Tensor, n: int, blocks: int) -> tuple[Tensor, Tensor]:
    """Tensors for a kernel's products and counts, [18, N] and [blocks, 14]."""
    return like.new_empty(3 * GROUPS, n, dtype=torch.float64), like.new_empty(blocks, COUNTS, dtype=torch.int32)


def products_of(names: Sequence[str], table: Tensor, counts: Tensor) -> conflicts.Products:
    """The `Products` of tensors that a kernel has written."""
    sums = deferred.elements(counts.sum(0))
    dot, l2, h2 = (x.T for x in table.view(3, GROUPS, -1))
    return conflicts.Products(names, dot, l2, h2, sums[:7], sums[7:])


@wp.func
def weight(w: Weight, group: wp.int32, i: wp.int32) -> wp.float64:
    if w.rows.shape[0] > 0:
        return w.rows[group * w.stride + i]
    return w.number


@wp.func
def reconciled(high: wp.float32, low: wp.float32, keep: wp.float64, remove: wp.float64) -> wp.float32:
    """ĝ_HR (Eq. 7), with the bits of g_HR where keep is 1 and remove is 0."""
    return wp.float32(wp.float64(high) * keep - wp.float64(low) * remove)


@wp.func
def compared_and_opposed(products: wp.vec3d) -> wp.vec2i:
    """Whether neither gradient is zero, and whether their cosine is also below 0; 0 or 1."""
    zero = wp.float64(0.0)
    comparable = wp.where(products[1] > zero and products[2] > zero, 1, 0)
    return wp.vec2i(comparable, wp.where(products[0] < zero, comparable, 0))


@wp.func
def counted(p: Products) -> Counts:
    """The counts of one Gaussian."""
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


@wp.struct
class Rows:
    """One attribute's gradients; an array that is not there is empty."""

    lr: wp.array[wp.float32]
    hr: wp.array[wp.float32]
    plus: wp.array[wp.float32]
    out: wp.array[wp.float32]
    width: wp.int32
    first_band: wp.int32  # of the spherical harmonics; -1: others


@wp.struct
class Factors:
    """A gradient of the spherical harmonics, Y ⊗ ∇rgb; empty: none."""

    rgb: wp.array2d[wp.float32]
    basis: wp.array2d[wp.float32]


@wp.struct
class Options:
    """Options that all attributes share."""

    lr: Factors
    hr: Factors
    lambda_hr: wp.float32
    keeps_lr: wp.bool


@wp.func
def product(f: Factors, a: Rows, i: wp.int32, d: wp.int32) -> wp.float32:
    """The d-th number of an attribute's row of Y ⊗ ∇rgb."""
    band = a.first_band + d / 3
    if a.first_band < 0 or band >= f.basis.shape[1]:
        return 0.0
    return f.basis[i, band] * f.rgb[i, d % 3]


@wp.func
def gradient(rows: wp.array[wp.float32], f: Factors, a: Rows, i: wp.int32, d: wp.int32) -> wp.float32:
    """The d-th number of an attribute's row of a gradient, of its rows and factors."""
    g = product(f, a, i, d)
    if rows.shape[0] > 0:
        g += rows[i * a.width + d]
    return g


@wp.func
def compared(a: Rows, i: wp.int32, o: Options) -> wp.vec3d:
    total = wp.vec3d()
    for d in range(a.width):
        g_lr, g_hr = wp.float64(gradient(a.lr, o.lr, a, i, d)), wp.float64(gradient(a.hr, o.hr, a, i, d))
        total += wp.vec3d(g_lr * g_hr, g_lr * g_lr, g_hr * g_hr)
    return total


@wp.kernel
def compare(
    means: Rows, quats: Rows, scales: Rows, opacities: Rows, sh0: Rows, shN: Rows, o: Options,
    table: wp.array2d[wp.float64], counts: wp.array[Counts],
) -> None:  # fmt: skip
    """The products of one Gaussian, and what is counted."""
    block, lane = wp.tid()
    i = block * wp.block_dim() + lane
    tally = Counts()
    if i < table.shape[1]:
        p = Products()
        p[MEANS] = compared(means, i, o)
        p[SH0] = compared(sh0, i, o)
        p[SHN] = compared(shN, i, o)
        p[OPACITIES] = compared(opacities, i, o)
        p[SCALES] = compared(scales, i, o)
        p[QUATS] = compared(quats, i, o)
        store(p, table, i)
        tally = counted(p)
    wp.tile_store(counts, wp.tile_sum(wp.tile(tally, preserve_type=True)), offset=(block,))


@wp.func
def write(
    a: Rows, i: wp.int32, d: wp.int32, keep: wp.float64, remove: wp.float64, o: Options, lambda_hr: wp.float32,
    finite: wp.array[wp.int32],
) -> None:  # fmt: skip
    at = i * a.width + d
    g_lr = gradient(a.lr, o.lr, a, i, d)
    total = reconciled(gradient(a.hr, o.hr, a, i, d), g_lr, keep, remove)  # Eq. 7
    if o.keeps_lr:
        total = g_lr + total * lambda_hr  # Eq. 8
    if a.plus.shape[0] > 0:
        total += a.plus[at]
    if not wp.isfinite(total):
        finite[0] = 0
    a.out[at] = total


@wp.func
def write_group(
    a: Rows, i: wp.int32, d: wp.int32, group: wp.int32, w: Weights, o: Options, lambda_hr: wp.float32,
    finite: wp.array[wp.int32],
) -> wp.int32:  # fmt: skip
    """Write the d-th number of a row if it has one. Returns which number of the attributes after this one it is, else < 0."""
    if d >= 0 and d < a.width:
        write(a, i, d, weight(w.keep, group, i), weight(w.remove, group, i), o, lambda_hr, finite)
    return d - a.width


@wp.kernel
def combine(
    means: Rows, quats: Rows, scales: Rows, opacities: Rows, sh0: Rows, shN: Rows, detail: Rows, o: Options, w: Weights,
    changing: wp.array[wp.float32], finite: wp.array[wp.int32],
) -> None:  # fmt: skip
    """Thread (i, j) writes the j-th number of Gaussian i, over the attributes side by side."""
    i, j = wp.tid()
    lambda_hr = wp.float32(o.lambda_hr)
    if changing.shape[0] > 0:  # of a recording
        lambda_hr = wp.float32(changing[0])
    d = write_group(shN, i, j, SHN, w, o, lambda_hr, finite)
    d = write_group(means, i, d, MEANS, w, o, lambda_hr, finite)
    d = write_group(quats, i, d, QUATS, w, o, lambda_hr, finite)
    d = write_group(scales, i, d, SCALES, w, o, lambda_hr, finite)
    d = write_group(opacities, i, d, OPACITIES, w, o, lambda_hr, finite)
    d = write_group(sh0, i, d, SH0, w, o, lambda_hr, finite)
    if d >= 0:
        write(detail, i, d, wp.float64(1.0), wp.float64(0.0), o, lambda_hr, finite)


def products(lr: Grads, hr: Grads, names: Sequence[str]) -> conflicts.Products:
    """See `kernels.reconcile.products`."""
    lr, hr = contiguous(lr), contiguous(hr)
    like = next(iter(lr.tensors.values()))
    n = len(like)
    blocks = -(-n // lanes_on(like.device, LANES))
    rows = [_rows(name, row_width(name, lr, hr) if name in names else 0, lr, hr, Grads(), None) for name in _ORDER[:-1]]
    table, counts = product_table(like, n, blocks)
    launch(compare, [blocks], (*rows, _options(lr, hr), table, counts), block=LANES, together=True)
    return products_of(names, table, counts)


def apply(
    out: Mapping[str, Tensor], lr: Grads, hr: Grads, weights: conflicts.Weights, lambda_hr: float | Tensor, plus: Grads,
    keeps_lr: bool,
) -> Number:  # fmt: skip
    """See `kernels.reconcile.apply`."""
    lr, hr, plus, like = contiguous(lr), contiguous(hr), contiguous(plus), next(iter(out.values()))
    n = len(like)
    rows = [
        _rows(name, out[name].shape[1:].numel() if name in out else 0, lr, hr, plus, out.get(name)) for name in _ORDER
    ]
    tables, finite = weight_tables(weights, n, like.device), like.new_ones(1, dtype=torch.int32)
    changing = lambda_hr if isinstance(lambda_hr, Tensor) else None
    options = _options(lr, hr, 0.0 if isinstance(lambda_hr, Tensor) else lambda_hr, keeps_lr)
    combined = *rows, options, weights_of(tables), changing, finite
    launch(combine, [n, sum(row.width for row in rows)], combined, block=LANES)
    return deferred.scalar(finite[0])


def _options(lr: Grads, hr: Grads, lambda_hr: float = 1.0, keeps_lr: bool = True) -> Any:
    low, high = (struct(Factors, **({} if c is None else c._asdict())) for c in (lr.colour, hr.colour))
    return struct(Options, lr=low, hr=high, lambda_hr=lambda_hr, keeps_lr=keeps_lr)


def _rows(name: str, width: int, lr: Grads, hr: Grads, plus: Grads, out: Tensor | None) -> Any:
    """An attribute for the kernels; one of width 0 is absent."""
    if width == 0:
        return struct(Rows)
    first_band = FIRST_BANDS.get(name, -1)
    return struct(
        Rows, lr=lr.get(name), hr=hr.get(name), plus=plus.get(name), out=out, width=width, first_band=first_band
    )
