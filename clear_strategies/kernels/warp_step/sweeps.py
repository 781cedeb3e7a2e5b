"""What runs on the device: a sweep that counts, one that merges, corrects, anchors and steps, and one for the rows of shN.

A Gaussian has a thread; of shN, with three quarters of all numbers, every number has one, so that neighbours read and
write side by side. In between lies a table of colours: shN's gradient is Y ⊗ colour, also when it is merged.

Products and sums round as they do in torch (no contraction), so gradients agree with the readable path bit for bit where
it matters: equal decisions. What is counted is added up block by block, and the blocks by torch: every sum has one order.
"""

from __future__ import annotations

from typing import Any, Final, no_type_check

import warp as wp

from clear_strategies.kernels.warp_step.adam import AdamStep, Attribute, is_still, step_number
from clear_strategies.kernels.warp_step.conflict import (
    GROUPS,
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    SHN,
    Corrected,
    Rule,
    correct,
    corrected3,
    group_products,
    merged1,
    merged3,
    merged4,
)
from clear_strategies.kernels.warp_step.pulled import Activation, Gradient, View, load, route_of, size

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

Compared: Final[Any] = wp.types.vector(length=26, dtype=wp.float64)
"""Comparable and opposed [7] each, Σ ‖l‖ and Σ ‖h‖ [6] each."""
Counted: Final[Any] = wp.types.vector(length=20, dtype=wp.float64)
"""Corrected rows, Σ ω and rows with ω at its lower bound [6] each; rows that were still, and that were not visible."""


@wp.struct
@no_type_check
class Sweep:
    """What a step is to do beside Adam's arithmetic."""

    lambda_hr: wp.float32
    corrects: wp.bool
    judged: wp.bool  # a reliability is given, else q = 0
    skips: wp.bool  # leave out rows that would not move
    chooses: wp.bool  # only visible rows may step
    width: wp.int32  # numbers of an shN row that are stepped


@wp.kernel
@no_type_check
def compare(
    activation: Activation,
    lr: Gradient,
    base: Gradient,
    hf: Gradient,
    view: View,
    keeps: wp.bool,
    norm_products: wp.array2d[wp.float64],
    blocks: wp.array[Compared],
) -> None:
    """A thread per Gaussian: is it comparable, does it point apart, and how long are its gradients?"""
    block, lane = wp.tid()
    i = block * wp.block_dim() + lane
    found = Compared()
    if i < view.n:
        g_lr, g_hr, _ = load(activation, lr, base, hf, view, i)
        p = group_products(g_lr, g_hr, lr, base, view, i)
        for k in range(GROUPS + 1):
            comparable = p.l2[k] > wp.float64(0.0) and p.h2[k] > wp.float64(0.0)
            if comparable:
                found[k] = wp.float64(1.0)
                if p.dot[k] < wp.float64(0.0):
                    found[7 + k] = wp.float64(1.0)
            if k < GROUPS:
                norm_l, norm_h = wp.sqrt(p.l2[k]), wp.sqrt(p.h2[k])
                if comparable:
                    found[14 + k] = norm_l
                    found[20 + k] = norm_h
                if keeps:
                    norm_products[k, i] = norm_l * norm_h
    wp.tile_store(blocks, wp.tile_sum(wp.tile(found, preserve_type=True)), offset=(block,))


@wp.func
@no_type_check
def keep_colour(colours: wp.array3d[wp.float32], which: wp.int32, i: wp.int32, rgb: wp.vec3) -> None:
    for channel in range(3):
        colours[which, i, channel] = rgb[channel]


@wp.kernel
@no_type_check
def step(
    activation: Activation,
    lr: Gradient,
    base: Gradient,
    hf: Gradient,
    view: View,
    rule: Rule,
    eps_cos: wp.array[wp.float64],
    eps_corr: wp.array[wp.float64],
    reliability: wp.array[wp.float32],
    sweep: Sweep,
    adam: AdamStep,
    means: Attribute,
    quats: Attribute,
    scales: Attribute,
    opacities: Attribute,
    sh0: Attribute,
    detail: Attribute,
    shN: Attribute,
    visible: wp.array[wp.uint8],
    colours: wp.array3d[wp.float32],
    moving: wp.array[wp.bool],
    blocks: wp.array[Counted],
) -> None:
    """A thread per Gaussian: everything but shN, of which the merged colour is left in `colours`.

    Where LR and HR have bases of their own there are two colours, one for each.
    """
    block, lane = wp.tid()
    at = block * wp.block_dim() + lane
    i = wp.min(at, view.n - 1)  # lanes beyond the last Gaussian count nothing and write nothing
    g_lr, g_hr, g_hf = load(activation, lr, base, hf, view, i)
    seen = not sweep.chooses or visible[i] != wp.uint8(0)
    still = False
    if sweep.skips and size(g_lr) + size(g_hr) + size(g_hf) <= 0.0:
        still = is_still(means, i, 3) and is_still(quats, i, 4) and is_still(scales, i, 3)
        still = still and is_still(opacities, i, 1) and is_still(sh0, i, 3) and is_still(detail, i, 3)
        still = still and is_still(shN, i, sweep.width)
    change = Corrected()
    if sweep.corrects:
        q = wp.float64(0.0)
        if sweep.judged:
            q = wp.float64(reliability[i])
        change = correct(group_products(g_lr, g_hr, lr, base, view, i), rule, eps_cos, eps_corr, q)

    count = Counted()
    if at < view.n:
        for k in range(GROUPS):
            count[k] = change.rows[k]
            count[6 + k] = change.omega[k]
            count[12 + k] = change.at_lower_bound[k]
        if not seen:
            count[19] = wp.float64(1.0)
        elif still:
            count[18] = wp.float64(1.0)
    wp.tile_store(blocks, wp.tile_sum(wp.tile(count, preserve_type=True)), offset=(block,))
    if at >= view.n:
        return

    moves, λ = seen and not still, sweep.lambda_hr
    d_means = merged3(g_lr.means, g_hr.means, change.step[MEANS], λ)
    d_quats = merged4(g_lr.quats, g_hr.quats, change.step[QUATS], λ)
    d_scales = merged3(g_lr.scales, g_hr.scales, change.step[SCALES], λ)
    d_opacity = merged1(g_lr.opacity, g_hr.opacity, change.step[OPACITIES], λ)
    d_sh0 = merged3(g_lr.sh0, g_hr.sh0, change.step[SH0], λ)
    # f_det: never corrected, never from L_base
    d_detail = g_hf.rgb * route_of(activation, view, i) * view.lambda_hf * λ
    if view.one_basis:
        keep_colour(colours, 0, i, merged3(g_lr.rgb, g_hr.rgb, change.step[SHN], λ))
    else:
        keep_colour(colours, 0, i, corrected3(g_lr.rgb, g_lr.rgb, change.step[SHN] * wp.float64(λ)))
        keep_colour(colours, 1, i, g_hr.rgb * λ)
    moving[i] = moves
    for d in range(3):
        step_number(adam, means, 3 * i + d, d_means[d], moves)
        step_number(adam, scales, 3 * i + d, d_scales[d], moves)
        step_number(adam, sh0, 3 * i + d, d_sh0[d], moves)
        step_number(adam, detail, 3 * i + d, d_detail[d], moves)
    for d in range(4):
        step_number(adam, quats, 4 * i + d, d_quats[d], moves)
    step_number(adam, opacities, i, d_opacity, moves)


@wp.kernel
@no_type_check
def step_bands(
    view: View,
    lr_basis: wp.array2d[wp.float32],
    hr_basis: wp.array2d[wp.float32],
    colours: wp.array3d[wp.float32],
    moving: wp.array[wp.bool],
    adam: AdamStep,
    shN: Attribute,
) -> None:
    """A thread per number of shN's active bands."""
    i, j = wp.tid()
    if not moving[i]:
        return
    band, channel = 1 + j / 3, j % 3
    gradient = wp.float32(0.0)
    if band < view.bases:
        gradient = lr_basis[i, band] * colours[0, i, channel]
        if view.has_base and not view.one_basis:
            gradient += hr_basis[i, band] * colours[1, i, channel]
    step_number(adam, shN, shN.width * i + j, gradient, True)
