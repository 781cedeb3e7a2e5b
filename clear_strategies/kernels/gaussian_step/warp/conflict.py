"""The conflict between LR and HR gradients by group, and the correction of the HR gradient (Eq. 6, 7, 11).

Decisions are made in float64, where no product of two floats over- or underflows. Groups are numbered as in
core.gradients.CONFLICT_GROUPS, and the whole Gaussian is a seventh.
"""

from __future__ import annotations

from typing import Any, Final

import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.compiled_rules import ROTATION_NOISE, CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.kernels.gaussian_step.warp.raw_gradients import Gradient, RawGradient, View, basis_products
from rasterizers.warp_runtime import struct

GROUPS: Final = wp.constant(6)
MEANS: Final = wp.constant(0)
SH0: Final = wp.constant(1)
SHN: Final = wp.constant(2)
OPACITIES: Final = wp.constant(3)
SCALES: Final = wp.constant(4)
QUATS: Final = wp.constant(5)
SMALLEST: Final = wp.constant(wp.float64(2.2250738585072014e-308))

Six: Final[Any] = wp.types.vector(length=6, dtype=wp.float64)
Seven: Final[Any] = wp.types.vector(length=7, dtype=wp.float64)
COUNTS: Final = 27
Counts: Final[Any] = wp.types.vector(length=COUNTS, dtype=wp.int32)
"""Comparable and opposed Gaussians, [7] each; rows corrected, and with ω at its lower bound, [6] each; still rows."""


@wp.struct
class Products:
    """⟨l, h⟩, ‖l‖², ‖h‖² by group and of the whole Gaussian."""

    dot: Seven
    l2: Seven
    h2: Seven


@wp.struct
class Rule:
    """GCO's settings."""

    groups: wp.int32  # bit k: group k is corrected
    tolerance: wp.float64
    weight_min: wp.float64
    weight_max: wp.float64
    rotation_noise: wp.float64  # a ‖g_quats‖ up to this times ‖g_scales‖ counts as rounding
    has_reliability: wp.bool  # else q = 0


def rule_of(rule: CorrectionRule | None, q: Tensor | None) -> Any:
    """The rule as kernels take it; None: nothing is corrected."""
    if rule is None:
        return struct(Rule, {})
    return struct(
        Rule, {}, groups=sum(on << k for k, on in enumerate(rule.corrects)), tolerance=rule.tolerance,
        weight_min=rule.weight_min, weight_max=rule.weight_max, rotation_noise=ROTATION_NOISE, has_reliability=q is not None,
    )  # fmt: skip


def counts_of(sums: Int[Tensor, " 27"], omegas: Float[Tensor, " 6"]) -> ConflictCounts:
    """The numbers of a sum of `Counts`, and those of ω, by what they count."""
    counts, seven, six = deferred.elements(sums), int(GROUPS) + 1, int(GROUPS)
    comparable, opposed, rest = counts[:seven], counts[seven : 2 * seven], counts[2 * seven :]
    return ConflictCounts(comparable, opposed, rest[:six], deferred.elements(omegas), rest[six : 2 * six])


@wp.struct
class Corrected:
    """By group, the multiple of g_LR that is subtracted from the HR gradient, and ω. Bit k of `rows` and `at_lower_bound`:
    group k is corrected, and its ω is at the lower bound.
    """

    multiple: Six
    omega: Six
    rows: wp.int32
    at_lower_bound: wp.int32


@wp.func
def products3(low: wp.vec3, high: wp.vec3) -> wp.vec3d:
    a, b = wp.vec3d(low), wp.vec3d(high)
    return wp.vec3d(wp.dot(a, b), wp.dot(a, a), wp.dot(b, b))


@wp.func
def products4(low: wp.vec4, high: wp.vec4) -> wp.vec3d:
    a, b = wp.vec4d(low), wp.vec4d(high)
    return wp.vec3d(wp.dot(a, b), wp.dot(a, a), wp.dot(b, b))


@wp.func
def group_products(
    low: RawGradient, high: RawGradient, lr: Gradient, base: Gradient, view: View, i: wp.int32
) -> Products:
    a, b = wp.float64(low.opacity), wp.float64(high.opacity)
    means, sh0, scales = (
        products3(low.means, high.means),
        products3(low.sh0, high.sh0),
        products3(low.scales, high.scales),
    )
    shN = wp.cw_mul(basis_products(lr, base, view, i), products3(low.rgb, high.rgb))
    opacities, quats = wp.vec3d(a * b, a * a, b * b), products4(low.quats, high.quats)
    total = means + sh0 + shN + opacities + scales + quats
    p = Products()
    p.dot = Seven(means[0], sh0[0], shN[0], opacities[0], scales[0], quats[0], total[0])
    p.l2 = Seven(means[1], sh0[1], shN[1], opacities[1], scales[1], quats[1], total[1])
    p.h2 = Seven(means[2], sh0[2], shN[2], opacities[2], scales[2], quats[2], total[2])
    return p


@wp.func
def turns_something(p: Products, rotation_noise: wp.float64) -> wp.bool:
    """Whether the rotation gradient is not noise: a Gaussian with equal axes does not change under rotation."""
    noise2 = rotation_noise * rotation_noise
    return p.l2[QUATS] > noise2 * p.l2[SCALES] and p.h2[QUATS] > noise2 * p.h2[SCALES]


@wp.func
def correct(p: Products, rule: Rule, reliability: wp.array[wp.float32], i: wp.int32) -> Corrected:
    """The corrections of a Gaussian by group (Eq. 6, 7, 11)."""
    multiple, omegas, rows, at_bound = Six(), Six(), wp.int32(0), wp.int32(0)
    one, tolerance, q = wp.float64(1.0), rule.tolerance, wp.float64(0.0)
    if rule.has_reliability:
        q = wp.float64(reliability[i])
    for k in range(GROUPS):
        apart = ((rule.groups >> k) & 1) == 1 and p.dot[k] < wp.float64(0.0)
        if k == QUATS:
            apart = apart and turns_something(p, rule.rotation_noise)
        if apart:
            n = wp.sqrt(p.l2[k] * p.h2[k])  # ‖low‖‖high‖; a product of four floats fits a float64
            cosine = p.dot[k] / wp.max(n, SMALLEST)  # Eq. 6
            if n > wp.float64(0.0) and cosine < -tolerance:
                omega = wp.clamp((-cosine - tolerance) / (one - tolerance), wp.float64(0.0), one) * (one - q)  # Eq. 11
                omega = wp.clamp(omega, rule.weight_min, rule.weight_max)
                multiple[k] = omega * ((p.dot[k] + tolerance * n) / p.l2[k])
                omegas[k] = omega
                rows |= 1 << k
                if omega <= rule.weight_min:
                    at_bound |= 1 << k
    out = Corrected()
    out.multiple = multiple
    out.omega = omegas
    out.rows = rows
    out.at_lower_bound = at_bound
    return out


@wp.func
def counted(p: Products, change: Corrected) -> Counts:
    """What one Gaussian adds to the counts; whether it is still is not known here."""
    tally = Counts()
    for k in range(GROUPS + 1):
        if p.l2[k] > wp.float64(0.0) and p.h2[k] > wp.float64(0.0):
            tally[k] = 1
            if p.dot[k] < wp.float64(0.0):
                tally[GROUPS + 1 + k] = 1
    for k in range(GROUPS):
        tally[14 + k] = (change.rows >> k) & 1
        tally[20 + k] = (change.at_lower_bound >> k) & 1
    return tally


@wp.func
def corrected3(high: wp.vec3, low: wp.vec3, multiple: wp.float64) -> wp.vec3:
    """ĝ_HR = g_HR - multiple · g_LR (Eq. 7); with multiple 0 it keeps its bits."""
    if multiple == wp.float64(0.0):
        return high
    return wp.vec3(wp.vec3d(high) - wp.vec3d(low) * multiple)


@wp.func
def merged3(low: wp.vec3, high: wp.vec3, multiple: wp.float64, weight: wp.float32) -> wp.vec3:
    """The sum g_LR + λ ĝ_HR (Eq. 8)."""
    return low + corrected3(high, low, multiple) * weight


@wp.func
def merged4(low: wp.vec4, high: wp.vec4, multiple: wp.float64, weight: wp.float32) -> wp.vec4:
    if multiple == wp.float64(0.0):
        return low + high * weight
    return low + wp.vec4(wp.vec4d(high) - wp.vec4d(low) * multiple) * weight


@wp.func
def merged1(low: wp.float32, high: wp.float32, multiple: wp.float64, weight: wp.float32) -> wp.float32:
    if multiple == wp.float64(0.0):
        return low + high * weight
    return low + wp.float32(wp.float64(high) - wp.float64(low) * multiple) * weight
