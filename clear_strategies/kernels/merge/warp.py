"""The merge in Warp, for CUDA, in two launches; the same kernels run on a CPU, to check them. Counts stay on the device.

`decide` has one thread per Gaussian, `combine` one per number, so that neighbouring threads write neighbouring memory. Importing
this module imports Warp; call `rasterizers.warp_runtime.require_warp` first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.compiled_rules import CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.kernels.gaussian_step.warp.conflict import (
    GROUPS,
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    SHN,
    Corrected,
    Counts,
    Products,
    Rule,
    Seven,
    Six,
    correct,
    counted,
    rule_of,
)
from clear_strategies.kernels.merge import interface
from rasterizers.warp_runtime import array, launch, on_stream, struct

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_LANES: Final = {"cuda": 128, "cpu": 1}  # threads per block; on a CPU, Warp's blocks have one
_ORDER: Final = ("means", "quats", "scales", "opacities", "sh0", "shN", "detail")
_ROWS: Final = ("out", "lr", "before", "hr", "p", "anchor")


@wp.struct
class Rows:
    """One attribute, see `kernels.merge.Rows`; bit k of `has` says whether the k-th array after `out` is there."""

    out: wp.array[wp.float32]
    lr: wp.array[wp.float32]
    before: wp.array[wp.float32]
    hr: wp.array[wp.float32]
    p: wp.array[wp.float32]
    anchor: wp.array[wp.float32]
    has: wp.int32
    width: wp.int32
    first_band: wp.int32  # of g^HR = Y ⊗ ∇rgb; -1: g^HR is `hr`, or 0
    stiffness: wp.float32


@wp.struct
class Options:
    """What holds for all attributes."""

    n: wp.int32
    bases: wp.int32
    lambda_hr: wp.float32
    scale: wp.float32
    keeps_lr: wp.bool
    corrects: wp.bool


@wp.func
def low(a: Rows, at: wp.int32, o: Options) -> wp.float32:
    """g_LR."""
    if (a.has & 1) == 0:
        return 0.0
    if (a.has & 2) != 0:
        return (a.lr[at] - a.before[at]) * (1.0 / o.scale)
    if o.scale != 1.0:
        return a.lr[at] * (1.0 / o.scale)
    return a.lr[at]


@wp.func
def high(
    a: Rows, i: wp.int32, d: wp.int32, o: Options, rgb: wp.array2d[wp.float32], basis: wp.array2d[wp.float32]
) -> wp.float32:
    """g^HR."""
    if (a.has & 4) != 0:
        return a.hr[i * a.width + d]
    band = a.first_band + d / 3
    if a.first_band < 0 or band >= o.bases:
        return 0.0
    return basis[i, band] * rgb[i, d % 3]


@wp.func
def products_of(
    a: Rows, i: wp.int32, o: Options, rgb: wp.array2d[wp.float32], basis: wp.array2d[wp.float32]
) -> wp.vec3d:
    total = wp.vec3d()
    for d in range(a.width):
        g_lr, g_hr = wp.float64(low(a, i * a.width + d, o)), wp.float64(high(a, i, d, o, rgb, basis))
        total += wp.vec3d(g_lr * g_hr, g_lr * g_lr, g_hr * g_hr)
    return total


@wp.kernel
def decide(
    means: Rows, quats: Rows, scales: Rows, opacities: Rows, sh0: Rows, shN: Rows, o: Options,
    rgb: wp.array2d[wp.float32], basis: wp.array2d[wp.float32], rule: Rule, reliability: wp.array[wp.float32],
    multiples: wp.array[Six], counts: wp.array[Counts], omegas: wp.array[Six],
) -> None:  # fmt: skip
    """The multiples of g_LR that are subtracted from g^HR, and what is counted."""
    block, lane = wp.tid()
    i = block * wp.block_dim() + lane
    tally, omega = Counts(), Six()
    if i < o.n:
        m, b, n = (
            products_of(means, i, o, rgb, basis),
            products_of(sh0, i, o, rgb, basis),
            products_of(shN, i, o, rgb, basis),
        )
        a, s, q = (
            products_of(opacities, i, o, rgb, basis),
            products_of(scales, i, o, rgb, basis),
            products_of(quats, i, o, rgb, basis),
        )
        total = m + b + n + a + s + q
        p = Products()
        p.dot = Seven(m[0], b[0], n[0], a[0], s[0], q[0], total[0])
        p.l2 = Seven(m[1], b[1], n[1], a[1], s[1], q[1], total[1])
        p.h2 = Seven(m[2], b[2], n[2], a[2], s[2], q[2], total[2])
        change = Corrected()
        if o.corrects:
            change = correct(p, rule, reliability, i)
        omega = change.omega
        tally = counted(p, change)
        multiples[i] = change.multiple
    wp.tile_store(counts, wp.tile_sum(wp.tile(tally, preserve_type=True)), offset=(block,))
    wp.tile_store(omegas, wp.tile_sum(wp.tile(omega, preserve_type=True)), offset=(block,))


@wp.func
def write(
    a: Rows, i: wp.int32, d: wp.int32, multiple: wp.float64, o: Options, rgb: wp.array2d[wp.float32],
    basis: wp.array2d[wp.float32], finite: wp.array[wp.int32],
) -> None:  # fmt: skip
    at = i * a.width + d
    g_lr, g_hr = low(a, at, o), high(a, i, d, o, rgb, basis)
    if multiple != wp.float64(0.0):
        g_hr = wp.float32(wp.float64(g_hr) - wp.float64(g_lr) * multiple)  # Eq. 7
    total = g_hr
    if o.keeps_lr:
        total = g_lr
        if o.lambda_hr > 0.0:
            total = g_lr + g_hr * o.lambda_hr  # Eq. 8
        if (a.has & 16) != 0:
            total += (a.p[at] - a.anchor[at]) * a.stiffness  # Eq. 16
        if o.scale != 1.0:
            total *= o.scale
        if (a.has & 2) != 0:
            total += a.before[at]
    if not wp.isfinite(total):
        finite[0] = 0
    a.out[at] = total


@wp.kernel
def combine(
    means: Rows, quats: Rows, scales: Rows, opacities: Rows, sh0: Rows, shN: Rows, detail: Rows, o: Options,
    rgb: wp.array2d[wp.float32], basis: wp.array2d[wp.float32], multiples: wp.array[Six], finite: wp.array[wp.int32],
) -> None:  # fmt: skip
    """Thread (i, j) writes the j-th number of Gaussian i, over the attributes side by side."""
    i, j = wp.tid()
    m = Six()
    if o.corrects:
        m = multiples[i]
    zero = wp.float64(0.0)
    d = j
    if d < shN.width:
        write(shN, i, d, m[SHN], o, rgb, basis, finite)
        return
    d -= shN.width
    if d < means.width:
        write(means, i, d, m[MEANS], o, rgb, basis, finite)
        return
    d -= means.width
    if d < quats.width:
        write(quats, i, d, m[QUATS], o, rgb, basis, finite)
        return
    d -= quats.width
    if d < scales.width:
        write(scales, i, d, m[SCALES], o, rgb, basis, finite)
        return
    d -= scales.width
    if d < opacities.width:
        write(opacities, i, d, m[OPACITIES], o, rgb, basis, finite)
        return
    d -= opacities.width
    if d < sh0.width:
        write(sh0, i, d, m[SH0], o, rgb, basis, finite)
        return
    write(detail, i, d - sh0.width, zero, o, rgb, basis, finite)


def merge(
    attributes: Mapping[str, interface.Rows], rule: CorrectionRule | None, q: Float[Tensor, " N"] | None, *,
    colour: interface.Colour | None = None, keeps_lr: bool = True, lambda_hr: float = 1.0, scale: float = 1.0,
) -> interface.Merged:  # fmt: skip
    """See `kernels.merge.Merge`."""
    like = next(iter(attributes.values())).out
    n, device = len(like), like.device
    rows = [_rows(name, attributes.get(name), has_colour=colour is not None) for name in _ORDER]
    rgb, basis = (like.new_empty(0, 1, dtype=torch.float32) for _ in range(2))
    if colour is not None:
        rgb, basis = colour.rgb.contiguous(), colour.basis.contiguous()
    lanes, corrects = _LANES[device.type], rule is not None and lambda_hr > 0
    o = struct(
        Options, {}, n=n, bases=1 if colour is None else basis.shape[1], lambda_hr=lambda_hr, scale=scale, keeps_lr=keeps_lr,
        corrects=corrects,
    )  # fmt: skip
    blocks = -(-n // lanes) if lambda_hr > 0 else 0
    counts = like.new_empty(blocks, 27, dtype=torch.int32)
    omegas, multiples = (like.new_empty(k, 6, dtype=torch.float64) for k in (blocks, n if blocks else 0))
    finite = like.new_ones(1, dtype=torch.int32)
    reliability = None if q is None else q.float().contiguous()
    decided = (
        *rows[:-1], o, array(rgb), array(basis), rule_of(rule, reliability), array(reliability), array(multiples, Six),
        array(counts, Counts), array(omegas, Six),
    )  # fmt: skip
    combined = *rows, o, array(rgb), array(basis), array(multiples, Six), array(finite)
    with on_stream(device):
        launch(decide, [blocks], decided, device, block=lanes, together=True)
        launch(combine, [n, sum(row.width for row in rows)], combined, device, block=lanes)
    seven, six = int(GROUPS) + 1, int(GROUPS)
    sums = counts.sum(0).split_with_sizes([seven, seven, six, six, 1])[:4]
    comparable, opposed, corrected, at_lower_bound, omega = (x.unbind() for x in (*sums, omegas.sum(0)))
    return interface.Merged(ConflictCounts(comparable, opposed, corrected, omega, at_lower_bound), finite[0])


def _rows(name: str, rows: interface.Rows | None, *, has_colour: bool) -> Any:
    """An attribute as the kernels take it; one that is absent has no numbers."""
    if rows is None:
        return struct(Rows, {})
    tensors = {field: getattr(rows, field) for field in _ROWS}
    return struct(
        Rows, tensors, has=sum(1 << k for k, field in enumerate(_ROWS[1:]) if tensors[field] is not None),
        width=rows.out.shape[1:].numel(), stiffness=rows.stiffness,
        first_band={"sh0": 0, "shN": 1}.get(name, -1) if has_colour else -1,
    )  # fmt: skip
