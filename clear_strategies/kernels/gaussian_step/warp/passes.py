"""The kernels of the step: `compare` writes the products of both gradients, `step` merges and applies Adam, and `step_bands` does
this for the rows of shN.

They use one thread per Gaussian, `step_bands` one per number, because shN has three quarters of all numbers and neighbouring
threads then access neighbouring memory. `step` passes it a table of colours: the merged gradient of shN is Y ⊗ colour.

Both gradients with respect to the raw parameters are computed per Gaussian and never stored. Products and sums round as in torch
(no contraction). Blocks sum their counts, and torch sums over the blocks: every sum has a fixed order.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from clear_strategies.kernels.reconcile.warp import (
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
    reconciled,
    store,
    weight,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Gradient:
    """One cotangent's rasterizers.interface.SplatGradients; rgb is the factor beside Y of the colour gradient.

    `detail`, of HR, is m λ_HF ∇L_HF of f_det. An array that is not there is empty.
    """

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    scales: wp.array[wp.vec3]
    opacities: wp.array[wp.float32]
    rgb: wp.array[wp.vec3]
    detail: wp.array[wp.vec3]


@wp.struct
class Activation:
    """The inputs of the activations' VJP (training.field.Activation), and Y."""

    scales: wp.array[wp.vec3]
    filtered: wp.array[wp.vec3]
    filter: wp.array[wp.float32]
    sigmoid: wp.array[wp.float32]
    factor: wp.array[wp.float32]
    basis: wp.array2d[wp.float32]


@wp.struct
class RawGradient:
    """∇θ of one loss for one Gaussian. shN's gradient stays in factors: Y ⊗ rgb."""

    means: wp.vec3
    quats: wp.vec4
    scales: wp.vec3
    opacity: wp.float32
    sh0: wp.vec3
    rgb: wp.vec3


@wp.func
def activation_vjp(g: Gradient, a: Activation, i: wp.int32) -> RawGradient:
    """The VJP of the 3D filter, exp and sigmoid. Same operations as training.field.Activation.vjp."""
    out = RawGradient()
    scales, filtered, reach = a.scales[i], a.filtered[i], a.filter[i]
    factor, sigmoid, d_opacity = a.factor[i], a.sigmoid[i], g.opacities[i]
    share = wp.vec3(reach / filtered[0], reach / filtered[1], reach / filtered[2])
    share = wp.cw_mul(share, share)  # log(coefficient) grows with log(s) by f² / (s² + f²)
    along = wp.cw_div(wp.cw_mul(g.scales[i], wp.cw_mul(scales, scales)), filtered)
    out.means = g.means[i]
    out.quats = g.quats[i]
    out.scales = along + d_opacity * (factor * sigmoid) * share
    out.opacity = d_opacity * factor * sigmoid * (1.0 - sigmoid)
    out.rgb = g.rgb[i]
    out.sh0 = a.basis[i, 0] * out.rgb
    return out


@wp.func
def load(activation: Activation, lr: Gradient, hr: Gradient, i: wp.int32) -> tuple[RawGradient, RawGradient]:
    """∇L_LR and g^HR of a Gaussian; 0 for one that is missing."""
    g_lr, g_hr = activation_vjp(lr, activation, i), RawGradient()
    if hr.means.shape[0] > 0:
        g_hr = activation_vjp(hr, activation, i)
    return g_lr, g_hr


@wp.func
def detail_of(hr: Gradient, i: wp.int32) -> wp.vec3:
    """The gradient of f_det, m λ_HF ∇L_HF; 0 if there is none."""
    g = wp.vec3()
    if hr.detail.shape[0] > 0:
        g = hr.detail[i]
    return g


@wp.func
def higher_bands2(a: Activation, i: wp.int32) -> wp.float64:
    """‖Y‖² over the higher bands, for ⟨Y ⊗ a, Y ⊗ b⟩ = ‖Y‖² ⟨a, b⟩."""
    total = wp.float64(0.0)
    for k in range(1, a.basis.shape[1]):
        y = wp.float64(a.basis[i, k])
        total += y * y
    return total


@wp.func
def size(g: RawGradient) -> wp.float32:
    """A norm that is 0 only if the gradient is 0; sh0 follows rgb."""
    shape = wp.norm_l1(g.means) + wp.norm_l1(g.quats) + wp.norm_l1(g.scales)
    return shape + wp.abs(g.opacity) + wp.norm_l1(g.rgb)


@wp.struct
class Rates:
    """Of each attribute, - learning rate / bias of the first moment."""

    means: wp.float32
    quats: wp.float32
    scales: wp.float32
    opacities: wp.float32
    sh0: wp.float32
    shN: wp.float32  # noqa: N815 - gsplat's name
    detail: wp.float32


@wp.struct
class AdamStep:
    """Numbers that change from step to step, and settings that all attributes share."""

    rates: Rates

    beta1: wp.float32
    beta2: wp.float32
    gain1: wp.float32  # 1 - β
    gain2: wp.float32
    per_bias2: wp.float32  # 1 / bias of the second moment
    eps: wp.float32
    lambda_hr: wp.float32
    lambda_hf: wp.float32  # λ_HR λ_HF, next to it; no kernel here reads it


@wp.struct
class Attribute:
    """A parameter with its moments, row-major, terms that are added to its gradient, if any, and its limits."""

    p: wp.array[wp.float32]
    m: wp.array[wp.float32]
    v: wp.array[wp.float32]
    hr: wp.array[wp.float32]  # ĝ_HR where a strategy has computed it
    plus: wp.array[wp.float32]
    width: wp.int32
    bounded: wp.bool  # a row that takes no step may still decay or be clamped
    keep: wp.float32  # factor of the decay per step (f_det), 1: none
    limit: wp.float32


@wp.kernel
def write(values: AdamStep, out: wp.array[AdamStep]) -> None:
    out[0] = values


@wp.func
def step_number(
    adam: AdamStep, a: Attribute, rate: wp.float32, at: wp.int32, gradient: wp.float32, moves: wp.bool
) -> None:
    """Decay, step and clamp one number; with `moves` False only decay and clamp it. As `training.optim.Adam`, but that the
    division by the second moment's bias is a multiplication here.
    """
    if not (moves or a.bounded):
        return
    p = a.p[at]
    g = gradient
    if a.hr.shape[0] > 0:
        g += a.hr[at] * adam.lambda_hr
    if a.plus.shape[0] > 0:
        g += a.plus[at]
    after = p * a.keep
    if moves:
        m = g * adam.gain1 + a.m[at] * adam.beta1
        v = g * adam.gain2 * g + a.v[at] * adam.beta2
        a.m[at] = m
        a.v[at] = v
        after += m * rate / (wp.sqrt(v * adam.per_bias2) + adam.eps)
    if after > a.limit:  # False for NaN, which stays
        after = a.limit
    elif after < -a.limit:
        after = -a.limit
    a.p[at] = after


@wp.func
def is_still(a: Attribute, i: wp.int32, width: wp.int32) -> wp.bool:
    """Whether a row without a gradient of the losses would not change: both moments, `hr` and `plus` are 0."""
    for at in range(a.width * i, a.width * i + width):
        if a.m[at] != 0.0 or a.v[at] != 0.0:
            return False
        if a.hr.shape[0] > 0 and a.hr[at] != 0.0:
            return False
        if a.plus.shape[0] > 0 and a.plus[at] != 0.0:
            return False
    return True


@wp.struct
class StepOptions:
    """The settings of a step that are the same in many."""

    merges: wp.bool  # there is a gradient of HR, and λ_HR > 0
    skips: wp.bool  # skip rows that would not change
    width: wp.int32  # numbers of an shN row that are stepped


@wp.func
def products(low: Any, high: Any) -> wp.vec3d:
    """Of two vectors."""
    total = wp.vec3d()
    for d in range(len(low)):
        a, b = wp.float64(low[d]), wp.float64(high[d])
        total += wp.vec3d(a * b, a * a, b * b)
    return total


@wp.func
def group_products(low: RawGradient, high: RawGradient, activation: Activation, i: wp.int32) -> Products:
    a, b = wp.float64(low.opacity), wp.float64(high.opacity)
    p = Products()
    p[MEANS] = products(low.means, high.means)
    p[SH0] = products(low.sh0, high.sh0)
    p[SHN] = higher_bands2(activation, i) * products(low.rgb, high.rgb)
    p[OPACITIES] = wp.vec3d(a * b, a * a, b * b)
    p[SCALES] = products(low.scales, high.scales)
    p[QUATS] = products(low.quats, high.quats)
    return p


@wp.func
def merged(low: Any, high: Any, w: Weights, group: wp.int32, i: wp.int32, lambda_hr: wp.float32) -> Any:
    """The sum g_LR + λ ĝ_HR (Eq. 8), of vectors."""
    keep, remove = weight(w.keep, group, i), weight(w.remove, group, i)
    g_hr = type(low)()
    for d in range(len(low)):
        g_hr[d] = reconciled(high[d], low[d], keep, remove)
    return low + g_hr * lambda_hr


@wp.kernel
def compare(
    activation: Activation, lr: Gradient, hr: Gradient, table: wp.array2d[wp.float64], counts: wp.array[Counts]
) -> None:  # fmt: skip
    block, lane = wp.tid()
    i, tally = block * wp.block_dim() + lane, Counts()
    if i < table.shape[1]:
        g_lr, g_hr = load(activation, lr, hr, i)
        p = group_products(g_lr, g_hr, activation, i)
        store(p, table, i)
        tally = counted(p)
    wp.tile_store(counts, wp.tile_sum(wp.tile(tally, preserve_type=True)), offset=(block,))


@wp.kernel
def step(
    activation: Activation,
    lr: Gradient,
    hr: Gradient,
    w: Weights,
    options: StepOptions,
    adams: wp.array[AdamStep],
    means: Attribute,
    quats: Attribute,
    scales: Attribute,
    opacities: Attribute,
    sh0: Attribute,
    detail: Attribute,
    shN: Attribute,
    colours: wp.array2d[wp.float32],
    moving: wp.array[wp.bool],
    stills: wp.array[wp.int32],
) -> None:
    """One thread per Gaussian: steps everything but shN, for which it writes the merged colour to `colours`."""
    block, lane = wp.tid()
    adam, n = adams[0], moving.shape[0]
    at = block * wp.block_dim() + lane
    i = wp.min(at, n - 1)  # lanes beyond the last Gaussian neither count nor write
    g_lr, g_hr = load(activation, lr, hr, i)
    g_detail = detail_of(hr, i)
    still = options.skips and size(g_lr) + size(g_hr) + wp.norm_l1(g_detail) <= 0.0
    still = still and is_still(means, i, 3) and is_still(quats, i, 4) and is_still(scales, i, 3)
    still = still and is_still(opacities, i, 1) and is_still(sh0, i, 3) and is_still(detail, i, 3)
    still = still and is_still(shN, i, options.width)
    moves, λ = not still, wp.float32(0.0)
    if options.merges:
        λ = adam.lambda_hr
    d_means = merged(g_lr.means, g_hr.means, w, MEANS, i, λ)
    d_quats = merged(g_lr.quats, g_hr.quats, w, QUATS, i, λ)
    d_scales = merged(g_lr.scales, g_hr.scales, w, SCALES, i, λ)
    keep, remove = weight(w.keep, OPACITIES, i), weight(w.remove, OPACITIES, i)
    d_opacity = g_lr.opacity + reconciled(g_hr.opacity, g_lr.opacity, keep, remove) * λ
    d_sh0 = merged(g_lr.sh0, g_hr.sh0, w, SH0, i, λ)
    d_detail = g_detail * adam.lambda_hr  # f_det gets only the routed gradient of L_HF, uncorrected
    d_rgb = merged(g_lr.rgb, g_hr.rgb, w, SHN, i, λ)

    count = wp.int32(0)
    if still and at < n:
        count = 1
    wp.tile_store(stills, wp.tile_sum(wp.tile(count)), offset=(block,))
    if at >= n:
        return

    moving[i] = moves
    for channel in range(3):
        colours[i, channel] = d_rgb[channel]
    for d in range(3):
        step_number(adam, means, adam.rates.means, 3 * i + d, d_means[d], moves)
        step_number(adam, scales, adam.rates.scales, 3 * i + d, d_scales[d], moves)
        step_number(adam, sh0, adam.rates.sh0, 3 * i + d, d_sh0[d], moves)
        step_number(adam, detail, adam.rates.detail, 3 * i + d, d_detail[d], moves)
    for d in range(4):
        step_number(adam, quats, adam.rates.quats, 4 * i + d, d_quats[d], moves)
    step_number(adam, opacities, adam.rates.opacities, i, d_opacity, moves)


@wp.kernel
def step_bands(
    basis: wp.array2d[wp.float32],
    colours: wp.array2d[wp.float32],
    moving: wp.array[wp.bool],
    adams: wp.array[AdamStep],
    shN: Attribute,
) -> None:
    """One thread per number of shN's stepped bands."""
    i, j = wp.tid()
    if not moving[i]:
        return
    adam, band, channel = adams[0], 1 + j / 3, j % 3
    gradient = wp.float32(0.0)
    if band < basis.shape[1]:
        gradient = basis[i, band] * colours[i, channel]
    step_number(adam, shN, adam.rates.shN, shN.width * i + j, gradient, True)
