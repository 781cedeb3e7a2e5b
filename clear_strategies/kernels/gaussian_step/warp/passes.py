"""The kernels of the step: `step` counts conflicts, merges, corrects, adds the anchor's gradient and applies Adam, and
`step_bands` does this for the rows of shN.

`step` uses one thread per Gaussian. `step_bands` uses one per number, because shN has three quarters of all
numbers and neighbouring threads then access neighbouring memory. `step` passes it a table of colours: the merged gradient
of shN is Y ⊗ colour.

Products and sums round as in torch (no contraction), so that the step makes the same decisions as the readable path.
Blocks sum their counts, and torch sums over the blocks: every sum has a fixed order.
"""

from __future__ import annotations

import warp as wp

from clear_strategies.kernels.gaussian_step.warp.adam import AdamStep, Attribute, is_still, step_number
from clear_strategies.kernels.gaussian_step.warp.conflict import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    SHN,
    Corrected,
    Counts,
    Rule,
    Six,
    correct,
    corrected3,
    counted,
    group_products,
    merged1,
    merged3,
    merged4,
)
from clear_strategies.kernels.gaussian_step.warp.raw_gradients import Activation, Gradient, View, load, route_of, size

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class StepOptions:
    """The settings of a step that are the same in many."""

    compares: wp.bool
    corrects: wp.bool
    skips: wp.bool  # skip rows that would not change
    width: wp.int32  # numbers of an shN row that are stepped


@wp.kernel
def step(
    activation: Activation,
    lr: Gradient,
    base: Gradient,
    hf: Gradient,
    view: View,
    rule: Rule,
    reliability: wp.array[wp.float32],
    options: StepOptions,
    adams: wp.array[AdamStep],
    means: Attribute,
    quats: Attribute,
    scales: Attribute,
    opacities: Attribute,
    sh0: Attribute,
    detail: Attribute,
    shN: Attribute,
    colours: wp.array3d[wp.float32],
    moving: wp.array[wp.bool],
    counts: wp.array[Counts],
    omegas: wp.array[Six],
) -> None:
    """One thread per Gaussian: steps everything but shN, for which it writes the merged colour to `colours`.

    If LR and HR have different bases, there are two colours, one for each.
    """
    block, lane = wp.tid()
    adam = adams[0]
    at = block * wp.block_dim() + lane
    i = wp.min(at, view.n - 1)  # lanes beyond the last Gaussian neither count nor write
    g_lr, g_hr, g_hf = load(activation, lr, base, hf, view, i)
    still = options.skips and size(g_lr) + size(g_hr) + size(g_hf) <= 0.0
    still = still and is_still(means, i, 3) and is_still(quats, i, 4) and is_still(scales, i, 3)
    still = still and is_still(opacities, i, 1) and is_still(sh0, i, 3) and is_still(detail, i, 3)
    still = still and is_still(shN, i, options.width)
    change, tally = Corrected(), Counts()
    if options.compares:
        products = group_products(g_lr, g_hr, lr, base, view, i)
        if options.corrects:
            change = correct(products, rule, reliability, i)
        tally = counted(products, change)

    moves, λ = not still, adam.lambda_hr
    d_means = merged3(g_lr.means, g_hr.means, change.multiple[MEANS], λ)
    d_quats = merged4(g_lr.quats, g_hr.quats, change.multiple[QUATS], λ)
    d_scales = merged3(g_lr.scales, g_hr.scales, change.multiple[SCALES], λ)
    d_opacity = merged1(g_lr.opacity, g_hr.opacity, change.multiple[OPACITIES], λ)
    d_sh0 = merged3(g_lr.sh0, g_hr.sh0, change.multiple[SH0], λ)
    # f_det gets only the routed gradient of L_HF, uncorrected
    d_detail = g_hf.rgb * route_of(activation, view, i) * view.lambda_hf * λ
    rgb_lr, rgb_hr = merged3(g_lr.rgb, g_hr.rgb, change.multiple[SHN], λ), wp.vec3()
    if not view.one_basis:
        rgb_lr, rgb_hr = corrected3(g_lr.rgb, g_lr.rgb, change.multiple[SHN] * wp.float64(λ)), g_hr.rgb * λ

    omega = change.omega
    if still:
        tally[26] = 1
    if at >= view.n:
        tally, omega = Counts(), Six()
    wp.tile_store(counts, wp.tile_sum(wp.tile(tally, preserve_type=True)), offset=(block,))
    wp.tile_store(omegas, wp.tile_sum(wp.tile(omega, preserve_type=True)), offset=(block,))
    if at >= view.n:
        return

    moving[i] = moves
    for channel in range(3):
        colours[0, i, channel] = rgb_lr[channel]
        if not view.one_basis:
            colours[1, i, channel] = rgb_hr[channel]
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
    view: View,
    lr_basis: wp.array2d[wp.float32],
    hr_basis: wp.array2d[wp.float32],
    colours: wp.array3d[wp.float32],
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
    if band < view.bases:
        gradient = lr_basis[i, band] * colours[0, i, channel]
        if view.has_base and not view.one_basis:
            gradient += hr_basis[i, band] * colours[1, i, channel]
    step_number(adam, shN, adam.rates.shN, shN.width * i + j, gradient, True)
