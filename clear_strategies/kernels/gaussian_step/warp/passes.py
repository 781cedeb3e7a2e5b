"""The kernels of the step: `compare` writes the products of both gradients, `step` merges and applies Adam, and `step_bands` does
this for the rows of shN; `write_dense` writes both gradients.

They use one thread per Gaussian, `step_bands` one per number, because shN has three quarters of all numbers and neighbouring
threads then access neighbouring memory. `step` passes it a table of colours: the merged gradient of shN is Y ⊗ colour.

Products and sums round as in torch (no contraction). Blocks sum their counts, and torch sums over the blocks: every sum has a
fixed order.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from clear_strategies.kernels.gaussian_step.warp.adam import AdamStep, Attribute, is_still, step_number
from clear_strategies.kernels.gaussian_step.warp.raw_gradients import (
    Activation,
    Gradient,
    RawGradient,
    View,
    detail_of,
    higher_bands2,
    load,
    size,
)
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
    reconciled,
    store,
    weight,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


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
    activation: Activation, lr: Gradient, hr: Gradient, view: View,
    table: wp.array2d[wp.float64], counts: wp.array[Counts],
) -> None:  # fmt: skip
    block, lane = wp.tid()
    i, tally = block * wp.block_dim() + lane, Counts()
    if i < view.n:
        g_lr, g_hr = load(activation, lr, hr, view, i)
        p = group_products(g_lr, g_hr, activation, i)
        store(p, table, i)
        tally = counted(p)
    wp.tile_store(counts, wp.tile_sum(wp.tile(tally, preserve_type=True)), offset=(block,))


@wp.struct
class Rows:
    """The gradient of the raw parameters with every number."""

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    scales: wp.array[wp.vec3]
    opacities: wp.array[wp.float32]
    sh0: wp.array[wp.vec3]
    shN: wp.array2d[wp.vec3]  # noqa: N815 - gsplat's name


@wp.func
def write_rows(g: RawGradient, basis: wp.array2d[wp.float32], i: wp.int32, to: Rows) -> None:
    to.means[i] = g.means
    to.quats[i] = g.quats
    to.scales[i] = g.scales
    to.opacities[i] = g.opacity
    to.sh0[i] = g.sh0
    for band in range(to.shN.shape[1]):
        basis_of_band = wp.float32(0.0)
        if 1 + band < basis.shape[1]:
            basis_of_band = basis[i, 1 + band]
        to.shN[i, band] = basis_of_band * g.rgb


@wp.kernel
def write_dense(
    activation: Activation, lr: Gradient, hr: Gradient, view: View, to_lr: Rows, to_hr: Rows
) -> None:  # fmt: skip
    i = wp.tid()
    g_lr, g_hr = load(activation, lr, hr, view, i)
    write_rows(g_lr, activation.basis, i, to_lr)
    write_rows(g_hr, activation.basis, i, to_hr)


@wp.kernel
def step(
    activation: Activation,
    lr: Gradient,
    hr: Gradient,
    view: View,
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
    adam = adams[0]
    at = block * wp.block_dim() + lane
    i = wp.min(at, view.n - 1)  # lanes beyond the last Gaussian neither count nor write
    g_lr, g_hr = load(activation, lr, hr, view, i)
    g_detail = detail_of(hr, view, i)
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
    if still and at < view.n:
        count = 1
    wp.tile_store(stills, wp.tile_sum(wp.tile(count)), offset=(block,))
    if at >= view.n:
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
