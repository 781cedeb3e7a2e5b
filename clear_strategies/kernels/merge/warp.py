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
from clear_strategies.kernels.gaussian_step.warp.conflict import (
    COUNTS,
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
    counts_of,
    rule_of,
)
from clear_strategies.kernels.merge import interface
from rasterizers.warp_runtime import launch, on_stream, struct

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
    first_band: wp.int32  # of the spherical harmonics; -1: others
    stiffness: wp.float32


@wp.struct
class Factors:
    """A gradient of the spherical harmonics, Y ⊗ ∇rgb; no bases: none."""

    rgb: wp.array[wp.float32]
    basis: wp.array[wp.float32]
    bases: wp.int32


@wp.struct
class Options:
    """What holds for all attributes."""

    n: wp.int32
    lr: Factors
    hr: Factors
    lambda_hr: wp.float32
    scale: wp.float32
    keeps_lr: wp.bool
    corrects: wp.bool


@wp.func
def product(f: Factors, a: Rows, i: wp.int32, d: wp.int32) -> wp.float32:
    """The d-th number of an attribute's row of Y ⊗ ∇rgb."""
    band = a.first_band + d / 3
    if a.first_band < 0 or band >= f.bases:
        return 0.0
    return f.basis[i * f.bases + band] * f.rgb[i * 3 + d % 3]


@wp.func
def low(a: Rows, i: wp.int32, d: wp.int32, o: Options) -> wp.float32:
    """g_LR."""
    at = i * a.width + d
    g = wp.float32(0.0)
    if (a.has & 1) != 0:
        g = a.lr[at]
    if (a.has & 2) != 0:
        g -= a.before[at]
    g += product(o.lr, a, i, d)
    if o.scale != 1.0:
        g *= 1.0 / o.scale
    return g


@wp.func
def high(a: Rows, i: wp.int32, d: wp.int32, o: Options) -> wp.float32:
    """g^HR."""
    if (a.has & 4) != 0:
        return a.hr[i * a.width + d]
    return product(o.hr, a, i, d)


@wp.func
def products_of(a: Rows, i: wp.int32, o: Options) -> wp.vec3d:
    total = wp.vec3d()
    for d in range(a.width):
        g_lr, g_hr = wp.float64(low(a, i, d, o)), wp.float64(high(a, i, d, o))
        total += wp.vec3d(g_lr * g_hr, g_lr * g_lr, g_hr * g_hr)
    return total


@wp.kernel
def decide(
    means: Rows, quats: Rows, scales: Rows, opacities: Rows, sh0: Rows, shN: Rows, o: Options,
    rule: Rule, reliability: wp.array[wp.float32],
    multiples: wp.array[Six], counts: wp.array[Counts], omegas: wp.array[Six],
) -> None:  # fmt: skip
    """The multiples of g_LR that are subtracted from g^HR, and what is counted."""
    block, lane = wp.tid()
    i = block * wp.block_dim() + lane
    tally, omega = Counts(), Six()
    if i < o.n:
        m, b, n = products_of(means, i, o), products_of(sh0, i, o), products_of(shN, i, o)
        a, s, q = products_of(opacities, i, o), products_of(scales, i, o), products_of(quats, i, o)
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
def write(a: Rows, i: wp.int32, d: wp.int32, multiple: wp.float64, o: Options, finite: wp.array[wp.int32]) -> None:
    at = i * a.width + d
    g_lr, g_hr = low(a, i, d, o), high(a, i, d, o)
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
    multiples: wp.array[Six], finite: wp.array[wp.int32],
) -> None:  # fmt: skip
    """Thread (i, j) writes the j-th number of Gaussian i, over the attributes side by side."""
    i, j = wp.tid()
    m = Six()
    if o.corrects:
        m = multiples[i]
    zero = wp.float64(0.0)
    d = j
    if d < shN.width:
        write(shN, i, d, m[SHN], o, finite)
        return
    d -= shN.width
    if d < means.width:
        write(means, i, d, m[MEANS], o, finite)
        return
    d -= means.width
    if d < quats.width:
        write(quats, i, d, m[QUATS], o, finite)
        return
    d -= quats.width
    if d < scales.width:
        write(scales, i, d, m[SCALES], o, finite)
        return
    d -= scales.width
    if d < opacities.width:
        write(opacities, i, d, m[OPACITIES], o, finite)
        return
    d -= opacities.width
    if d < sh0.width:
        write(sh0, i, d, m[SH0], o, finite)
        return
    write(detail, i, d - sh0.width, zero, o, finite)


def merge(
    attributes: Mapping[str, interface.Rows], rule: CorrectionRule | None, q: Float[Tensor, " N"] | None, *,
    lr_colour: interface.Colour | None = None, colour: interface.Colour | None = None,
    keeps_lr: bool = True, lambda_hr: float = 1.0, scale: float = 1.0,
) -> interface.Merged:  # fmt: skip
    """See `kernels.merge.Merge`."""
    like = next(iter(attributes.values())).out
    n, device = len(like), like.device
    rows = [_rows(name, attributes.get(name)) for name in _ORDER]
    lr, hr = (c if c is None else interface.Colour(*(x.contiguous() for x in c)) for c in (lr_colour, colour))
    lanes, corrects = _LANES[device.type], rule is not None and lambda_hr > 0
    o = struct(
        Options, {}, n=n, lr=_factors(lr), hr=_factors(hr), lambda_hr=lambda_hr, scale=scale, keeps_lr=keeps_lr, corrects=corrects
    )  # fmt: skip
    blocks = -(-n // lanes) if lambda_hr > 0 else 0
    counts = like.new_empty(blocks, COUNTS, dtype=torch.int32)
    omegas, multiples = (like.new_empty(k, 6, dtype=torch.float64) for k in (blocks, n if blocks else 0))
    finite = like.new_ones(1, dtype=torch.int32)
    reliability = None if q is None else q.float().contiguous()
    decided = *rows[:-1], o, rule_of(rule, reliability), reliability, multiples, counts, omegas
    combined = *rows, o, multiples, finite
    with on_stream(device):
        launch(decide, [blocks], decided, device, block=lanes, together=True)
        launch(combine, [n, sum(row.width for row in rows)], combined, device, block=lanes)
    return interface.Merged(counts_of(counts.sum(0), omegas.sum(0)), finite[0])


def _factors(colour: interface.Colour | None) -> Any:
    if colour is None:
        return struct(Factors, {})
    return struct(Factors, colour._asdict(), bases=colour.basis.shape[1])


def _rows(name: str, rows: interface.Rows | None) -> Any:
    """An attribute as the kernels take it; one that is absent has no numbers."""
    if rows is None:
        return struct(Rows, {})
    tensors = {field: getattr(rows, field) for field in _ROWS}
    return struct(
        Rows, tensors, has=sum(1 << k for k, field in enumerate(_ROWS[1:]) if tensors[field] is not None),
        width=rows.out.shape[1:].numel(), stiffness=rows.stiffness,
        first_band=interface.FIRST_BANDS.get(name, -1),
    )  # fmt: skip
