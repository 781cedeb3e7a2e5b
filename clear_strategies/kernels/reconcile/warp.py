"""Products and apply in Warp, for CUDA; the same kernels run on a CPU, to check them. Counts stay on the device.

`compare` has one thread per Gaussian, `combine` one per number, so that neighbouring threads write neighbouring memory. Importing
this module imports Warp; call `rasterizers.warp_runtime.require_warp` first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import torch
import warp as wp
from torch import Tensor

from clear_strategies.core import conflicts
from clear_strategies.core.deferred import Number, scalar
from clear_strategies.core.gradients import Grads
from clear_strategies.kernels.reconcile.tables import FIRST_BANDS, contiguous, row_width, weight_tables
from clear_strategies.kernels.reconcile.warp_functions import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    SHN,
    Counts,
    Products,
    Weights,
    counted,
    product_table,
    products_of,
    reconciled,
    store,
    weight,
    weights_of,
)
from rasterizers.warp_runtime import launch, on_stream, struct

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_LANES: Final = {"cuda": 128, "cpu": 1}  # threads per block; on a CPU, Warp's blocks have one
_ORDER: Final = ("means", "quats", "scales", "opacities", "sh0", "shN", "detail")


@wp.struct
class Rows:
    """One attribute's gradients; bit k of `has` says whether the k-th array is there."""

    lr: wp.array[wp.float32]
    hr: wp.array[wp.float32]
    plus: wp.array[wp.float32]
    out: wp.array[wp.float32]
    has: wp.int32
    width: wp.int32
    first_band: wp.int32  # of the spherical harmonics; -1: others


@wp.struct
class Factors:
    """A gradient of the spherical harmonics, Y ⊗ ∇rgb; empty: none."""

    rgb: wp.array2d[wp.float32]
    basis: wp.array2d[wp.float32]


@wp.struct
class Options:
    """What holds for all attributes."""

    n: wp.int32
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
def low(a: Rows, i: wp.int32, d: wp.int32, o: Options) -> wp.float32:
    """g_LR."""
    g = product(o.lr, a, i, d)
    if (a.has & 1) != 0:
        g += a.lr[i * a.width + d]
    return g


@wp.func
def high(a: Rows, i: wp.int32, d: wp.int32, o: Options) -> wp.float32:
    """g^HR."""
    g = product(o.hr, a, i, d)
    if (a.has & 2) != 0:
        g += a.hr[i * a.width + d]
    return g


@wp.func
def compared(a: Rows, i: wp.int32, o: Options) -> wp.vec3d:
    total = wp.vec3d()
    for d in range(a.width):
        g_lr, g_hr = wp.float64(low(a, i, d, o)), wp.float64(high(a, i, d, o))
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
    if i < o.n:
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
    g_lr = low(a, i, d, o)
    total = reconciled(high(a, i, d, o), g_lr, keep, remove)  # Eq. 7
    if o.keeps_lr:
        total = g_lr + total * lambda_hr  # Eq. 8
    if (a.has & 4) != 0:
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
    n, device, lanes = len(like), like.device, _LANES[like.device.type]
    blocks = -(-n // lanes)
    rows = [_rows(name, row_width(name, lr, hr) if name in names else 0, lr, hr, Grads(), None) for name in _ORDER[:-1]]
    table, counts = product_table(like, n, blocks)
    with on_stream(device):
        compared = *rows, _options(n, lr, hr), table, counts
        launch(compare, [blocks], compared, device, block=lanes, together=True)
    return products_of(names, table, counts)


def apply(
    out: Mapping[str, Tensor],
    lr: Grads,
    hr: Grads,
    weights: conflicts.Weights,
    lambda_hr: float | Tensor,
    plus: Grads,
    keeps_lr: bool,
) -> Number:
    """See `kernels.reconcile.apply`."""
    lr, hr, plus, like = contiguous(lr), contiguous(hr), contiguous(plus), next(iter(out.values()))
    n, device = len(like), like.device
    rows = [
        _rows(name, out[name].shape[1:].numel() if name in out else 0, lr, hr, plus, out.get(name)) for name in _ORDER
    ]
    tables, finite = weight_tables(weights, n, device), like.new_ones(1, dtype=torch.int32)
    changing = lambda_hr if isinstance(lambda_hr, Tensor) else None
    options = _options(n, lr, hr, 0.0 if isinstance(lambda_hr, Tensor) else lambda_hr, keeps_lr)
    with on_stream(device):
        combined = *rows, options, weights_of(tables), changing, finite
        launch(combine, [n, sum(row.width for row in rows)], combined, device, block=_LANES[device.type])
    return scalar(finite[0])


def _options(n: int, lr: Grads, hr: Grads, lambda_hr: float = 1.0, keeps_lr: bool = True) -> Any:
    low, high = (struct(Factors, {} if c is None else c._asdict()) for c in (lr.colour, hr.colour))
    return struct(Options, {}, n=n, lr=low, hr=high, lambda_hr=lambda_hr, keeps_lr=keeps_lr)


def _rows(name: str, width: int, lr: Grads, hr: Grads, plus: Grads, out: Tensor | None) -> Any:
    """An attribute as the kernels take it; one of no width is absent."""
    if width == 0:
        return struct(Rows, {})
    tensors = {"lr": lr.get(name), "hr": hr.get(name), "plus": plus.get(name), "out": out}
    has = sum(1 << k for k, x in enumerate([*tensors.values()][:-1]) if x is not None)
    return struct(Rows, tensors, has=has, width=width, first_band=FIRST_BANDS.get(name, -1))
