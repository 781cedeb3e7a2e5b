"""Where do LR and HR gradients disagree, and what becomes of the HR one? Decisions in float64: no product of two floats
over- or underflows there.  Eq. 6, 7, 11

Groups are numbered as in gradients.CONFLICT_GROUPS; as a seventh, the Gaussian as a whole.
"""

from __future__ import annotations

from typing import Any, Final, no_type_check

import warp as wp

from clear_strategies.kernels.gaussian_step.warp.pulled import Gradient, Pulled, View, basis_products

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


@wp.struct
@no_type_check
class Products:
    """⟨l, h⟩, ‖l‖², ‖h‖² by group, and of the Gaussian as a whole."""

    dot: Seven
    l2: Seven
    h2: Seven


@wp.struct
@no_type_check
class Rule:
    """GCO's settings; ε is read from device memory, where it was computed from what has been compared."""

    groups: wp.int32  # bit k: group k is corrected
    tolerance: wp.float64
    weight_min: wp.float64
    weight_max: wp.float64
    rotation_noise: wp.float64  # ‖g_quats‖ at or below this times ‖g_scales‖ is rounding
    bounds_hold_omega: wp.bool  # else they hold the coefficient
    judged: wp.bool  # a reliability is given, else q = 0


@wp.struct
@no_type_check
class Corrected:
    """By group: of which multiple of g_LR the HR gradient is freed, and ω; bit k: group k is, and with ω at its lower bound."""

    step: Six
    omega: Six
    rows: wp.int32
    at_lower_bound: wp.int32


@wp.func
@no_type_check
def products3(low: wp.vec3, high: wp.vec3) -> wp.vec3d:
    a, b = wp.vec3d(low), wp.vec3d(high)
    return wp.vec3d(wp.dot(a, b), wp.dot(a, a), wp.dot(b, b))


@wp.func
@no_type_check
def products4(low: wp.vec4, high: wp.vec4) -> wp.vec3d:
    a, b = wp.vec4d(low), wp.vec4d(high)
    return wp.vec3d(wp.dot(a, b), wp.dot(a, a), wp.dot(b, b))


@wp.func
@no_type_check
def group_products(low: Pulled, high: Pulled, lr: Gradient, base: Gradient, view: View, i: wp.int32) -> Products:
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
@no_type_check
def turns_something(p: Products, rotation_noise: wp.float64) -> wp.bool:
    """A Gaussian with equal axes does not change when it is turned: its rotation gradient is noise."""
    noise2 = rotation_noise * rotation_noise
    return p.l2[QUATS] > noise2 * p.l2[SCALES] and p.h2[QUATS] > noise2 * p.h2[SCALES]


@wp.func
@no_type_check
def correct(
    p: Products,
    rule: Rule,
    eps_cos: wp.array[wp.float64],
    eps_corr: wp.array[wp.float64],
    reliability: wp.array[wp.float32],
    i: wp.int32,
) -> Corrected:
    """Eq. 6, 7, 11"""
    step, omegas, rows, at_bound = Six(), Six(), wp.int32(0), wp.int32(0)
    one, tolerance, q = wp.float64(1.0), rule.tolerance, wp.float64(0.0)
    if rule.judged:
        q = wp.float64(reliability[i])
    for k in range(GROUPS):
        apart = ((rule.groups >> k) & 1) == 1 and p.dot[k] < wp.float64(0.0)
        if k == QUATS:
            apart = apart and turns_something(p, rule.rotation_noise)
        if apart:
            n = wp.sqrt(p.l2[k] * p.h2[k])  # ‖low‖‖high‖; squares of floats leave room for a product
            cosine = p.dot[k] / wp.max(n + eps_cos[k], SMALLEST)  # Eq. 6
            if n > wp.float64(0.0) and cosine < -tolerance:
                omega = wp.clamp((-cosine - tolerance) / (one - tolerance), wp.float64(0.0), one) * (one - q)  # Eq. 11
                coefficient = (p.dot[k] + tolerance * n) / (p.l2[k] + eps_corr[k])
                if rule.bounds_hold_omega:
                    omega = wp.clamp(omega, rule.weight_min, rule.weight_max)
                    step[k] = omega * coefficient
                else:
                    step[k] = -wp.clamp(wp.abs(omega * coefficient), rule.weight_min, rule.weight_max)
                omegas[k] = omega
                rows |= 1 << k
                if omega <= rule.weight_min:
                    at_bound |= 1 << k
    out = Corrected()
    out.step = step
    out.omega = omegas
    out.rows = rows
    out.at_lower_bound = at_bound
    return out


@wp.func
@no_type_check
def corrected3(high: wp.vec3, low: wp.vec3, step: wp.float64) -> wp.vec3:
    """ĝ_HR = g_HR - step · g_LR; with step 0 it is handed back bit for bit.  Eq. 7"""
    if step == wp.float64(0.0):
        return high
    return wp.vec3(wp.vec3d(high) - wp.vec3d(low) * step)


@wp.func
@no_type_check
def merged3(low: wp.vec3, high: wp.vec3, step: wp.float64, weight: wp.float32) -> wp.vec3:
    """The sum g_LR + λ ĝ_HR.  Eq. 8"""
    return low + corrected3(high, low, step) * weight


@wp.func
@no_type_check
def merged4(low: wp.vec4, high: wp.vec4, step: wp.float64, weight: wp.float32) -> wp.vec4:
    if step == wp.float64(0.0):
        return low + high * weight
    return low + wp.vec4(wp.vec4d(high) - wp.vec4d(low) * step) * weight


@wp.func
@no_type_check
def merged1(low: wp.float32, high: wp.float32, step: wp.float64, weight: wp.float32) -> wp.float32:
    if step == wp.float64(0.0):
        return low + high * weight
    return low + wp.float32(wp.float64(high) - wp.float64(low) * step) * weight
