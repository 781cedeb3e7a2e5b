"""Project: every Gaussian onto a pixel grid, with its colour; and the VJP from the pixels' sums to its tensors."""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from rasterizers.geometry import BLACK, REACH
from rasterizers.warp_backend.bins import count_tiles, depth_key, precision_y, reaches_image
from rasterizers.warp_backend.colour import colour_of
from rasterizers.warp_backend.geometry import (
    Footprint,
    centre_of,
    footprint_of,
    geometry_of,
    geometry_vjp,
    screen_vjp,
)
from rasterizers.warp_backend.sizes import SEGMENT
from rasterizers.warp_backend.types import FAR, SUMS, Cuts, Ellipse, Grid, Moments, Pose, width_of

wp.set_module_options({"enable_backward": False})

HUGE = 1e30  # such an ellipse, of 1e-15 px, covers no pixel centre, and the square would overflow


@wp.func
def half_box(f: Footprint, reach: wp.float32) -> wp.vec2:
    """Half the width and height, px, of the box around the ellipse `reach` standard deviations from the centre."""
    return reach * f.size * wp.vec2(wp.sqrt(f.a + f.kernel), wp.sqrt(f.c + f.kernel))


@wp.func
def ellipse_at(u: wp.float64, v: wp.float64, f: Footprint, opacity: wp.float32, cuts: Cuts) -> Ellipse:
    whole_u, whole_v = wp.round(u), wp.round(v)
    ellipse = Ellipse()
    ellipse.whole = wp.vec2(wp.float32(whole_u), wp.float32(whole_v))
    ellipse.rest = wp.vec2(wp.float32(u - whole_u), wp.float32(v - whole_v))
    ellipse.A = 0.5 * f.A
    ellipse.S = f.S
    ellipse.D = 0.5 * f.D
    ellipse.opacity = opacity * f.compensation
    ellipse.reach = wp.log(wp.max(ellipse.opacity, 1e-30) / cuts.alpha_min) * 1.001 + 1e-3
    ellipse.half = half_box(f, wp.sqrt(2.0 * wp.max(ellipse.reach, 0.0)))
    return ellipse


@wp.func
def is_visible(ellipse: Ellipse, grid: Grid) -> wp.bool:
    """Whether the ellipse reaches the image. The conditions say which are kept, because NaN fails each."""
    visible = ellipse.reach > 0.0 and ellipse.A < HUGE and precision_y(ellipse) < HUGE
    visible = visible and wp.abs(ellipse.whole[0]) < HUGE and wp.abs(ellipse.whole[1]) < HUGE
    visible = visible and ellipse.half[0] >= 0.0 and ellipse.half[1] >= 0.0
    if not visible:
        return False
    return reaches_image(ellipse, grid)


@wp.kernel
def project(
    poses: wp.array[Pose],
    grids: wp.array[Grid],
    cuts: Cuts,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    sh0: wp.array[wp.vec3],
    shN: wp.array2d[wp.vec3],
    offsets: wp.array[wp.vec3],
    first: wp.bool,
    keys: wp.array[wp.int32],
    places: wp.array[wp.int32],
    colours: wp.array[wp.vec3],
    slopes: wp.array[wp.mat33],
    depths: wp.array[wp.float32],
    ellipses: wp.array[Ellipse],
    means2d: wp.array[wp.vec2],
    visible: wp.array[wp.bool],
    counts: wp.array[wp.int32],
    flags: wp.array[wp.int64],
) -> None:
    """One thread per Gaussian. Depth key, colour and slope, which the grids share, are computed for the first grid that
    draws the Gaussian; and its depth, if `depths` is not empty.

    `flags` become 1: a number that was read is not finite; a Gaussian has more tiles than a `SEGMENT`; or than its square.
    """
    i = wp.tid()
    quat, opacity = quats[i], opacities[i]
    all_finite = wp.isfinite(means[i]) and wp.isfinite(quat) and wp.isfinite(scales[i]) and wp.isfinite(opacity)
    if first:
        keys[i] = FAR
        places[i] = i
    means2d[i] = wp.vec2(0.0, 0.0)
    visible[i] = False
    counts[i] = 0

    pose, grid = poses[0], grids[0]
    centre = centre_of(pose, means[i])
    if centre.z > cuts.near:
        u = grid.exact_focal[0] * centre.tan[0] + grid.exact_principal[0]
        v = grid.exact_focal[1] * centre.tan[1] + grid.exact_principal[1]
        means2d[i] = wp.vec2(wp.float32(u), wp.float32(v))
        if opacity >= cuts.alpha_min:
            footprint = footprint_of(geometry_of(pose, grid, centre, quat, scales[i]), grid, cuts)
            ellipse = ellipse_at(u, v, footprint, opacity, cuts)
            if is_visible(ellipse, grid):
                visible[i] = True
                count = count_tiles(ellipse, grid)
                if count > SEGMENT:
                    flags[1] = wp.int64(1)
                if count > SEGMENT * SEGMENT:
                    flags[2] = wp.int64(1)
                if count > 0:
                    counts[i] = count
                    if keys[i] == FAR:
                        keys[i] = depth_key(centre.z, cuts)
                        rgb, slope = colour_of(means[i], pose.center, sh0[i], shN, i)
                        colours[i] = rgb
                        if shN.shape[1] > 0:
                            slopes[i] = slope
                        if depths.shape[0] > 0:
                            depths[i] = wp.float32(centre.z)
                    ellipse.rgb = colours[i]
                    if offsets.shape[0] > 0:
                        ellipse.rgb += offsets[i]
                    ellipses[i] = ellipse
                    all_finite = all_finite and wp.isfinite(ellipse.rgb)
    if not all_finite:
        flags[0] = wp.int64(1)


@wp.kernel
def radii(
    poses: wp.array[Pose],
    grids: wp.array[Grid],
    cuts: Cuts,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    visible: wp.array[wp.bool],
    out: wp.array2d[wp.int32],
) -> None:
    """One thread per Gaussian; see `WithTraits`."""
    i = wp.tid()
    out[i, 0] = 0
    out[i, 1] = 0
    if not visible[i]:
        return
    pose, grid = poses[0], grids[0]
    f = footprint_of(geometry_of(pose, grid, centre_of(pose, means[i]), quats[i], scales[i]), grid, cuts)
    power = 2.0 * wp.log(opacities[i] * f.compensation / cuts.alpha_min)
    half = half_box(f, wp.min(wp.sqrt(wp.max(power, 0.0)), REACH))
    for c in range(2):
        out[i, c] = wp.int32(wp.clamp(wp.ceil(half[c]), 1.0, 1e9))


@wp.func
def stride_of(count: wp.int32) -> wp.int32:
    """The distance of the places whose sums, after `fold`, make up those of a Gaussian of `count` pairs."""
    stride = wp.int32(1)
    while count > stride * SEGMENT and stride < SEGMENT * SEGMENT:
        stride *= SEGMENT
    return stride


@cache
def fold(K: int, absolute: bool = False) -> Any:
    """The kernel that adds up a Gaussian's pairs by `SEGMENT`, for those Gaussians that have more."""
    PairSums = wp.types.vector(length=width_of(K, absolute), dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def fold(
        counts: wp.array[wp.int32],
        firsts: wp.array[wp.int32],
        splats: wp.array[wp.int32],
        total: wp.array[wp.int64],
        stride: wp.int32,
        pair_sums: wp.array[PairSums],
    ) -> None:
        """One thread per place; at every `SEGMENT`-th multiple of `stride` it adds the sums of the multiples up to the next."""
        place = wp.tid()
        if wp.int64(place) >= total[0]:
            return
        i = splats[place]
        nth, count = place - firsts[i], counts[i]
        if count <= stride * SEGMENT or nth % (stride * SEGMENT) != 0:
            return
        share = PairSums()
        for other in range(nth, wp.min(nth + stride * SEGMENT, count), stride):
            share += pair_sums[firsts[i] + other]
        pair_sums[place] = share

    return fold


@wp.func
def unclamped(colour: wp.vec3, d_colour: wp.vec3) -> wp.vec3:
    """∇rgb: where a colour is clamped, the image does not depend on it."""
    rgb = wp.vec3()
    for c in range(3):
        if colour[c] >= -BLACK:
            rgb[c] = d_colour[c]
    return rgb


@cache
def project_vjp(K: int, absolute: bool = False, summed: bool = False) -> Any:
    """The VJP kernel for K cotangents, with absolute gradients for one; or with the last added to the one before, see
    `interface.summed_vjp`.
    """
    W = SUMS + 3
    J = K - 1 if summed else K
    PairSums = wp.types.vector(length=width_of(K, absolute), dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def project_vjp(
        poses: wp.array[Pose],
        grids: wp.array[Grid],
        cuts: Cuts,
        means: wp.array[wp.vec3],
        quats: wp.array[wp.vec4],
        scales: wp.array[wp.vec3],
        opacities: wp.array[wp.float32],
        slopes: wp.array[wp.mat33],
        ellipses: wp.array[Ellipse],
        counts: wp.array[wp.int32],
        firsts: wp.array[wp.int32],
        pair_sums: wp.array[PairSums],
        d_means: wp.array2d[wp.vec3],
        d_quats: wp.array2d[wp.vec4],
        d_scales: wp.array2d[wp.vec3],
        d_opacities: wp.array2d[wp.float32],
        d_screen: wp.array2d[wp.vec2],
        d_rgb: wp.array2d[wp.vec3],
        d_absolute: wp.array2d[wp.vec2],
        weights: wp.array[wp.float32],
    ) -> None:
        """One thread per Gaussian: adds its pairs' sums in the order of its tiles, and applies the projection's VJP."""
        i = wp.tid()
        if counts[i] == 0:
            for k in range(J):
                d_means[k, i] = wp.vec3(0.0, 0.0, 0.0)
                d_quats[k, i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
                d_scales[k, i] = wp.vec3(0.0, 0.0, 0.0)
                d_opacities[k, i] = 0.0
            for k in range(K):
                d_screen[k, i] = wp.vec2(0.0, 0.0)
                d_rgb[k, i] = wp.vec3(0.0, 0.0, 0.0)
            if wp.static(absolute):
                d_absolute[0, i] = wp.vec2(0.0, 0.0)
            return
        total = PairSums()
        for nth in range(0, counts[i], stride_of(counts[i])):
            total += pair_sums[firsts[i] + nth]
        pose, grid = poses[0], grids[0]
        g = geometry_of(pose, grid, centre_of(pose, means[i]), quats[i], scales[i])
        f = footprint_of(g, grid, cuts)
        colour = ellipses[i].rgb
        for k in range(K):
            d_screen[k, i] = screen_vjp(f, wp.vec2(total[W * k + 1], total[W * k + 2]))
        if wp.static(summed):  # the projection is linear in the sums
            for c in range(W):
                share = total[W * J + c] * weights[i]
                total[W * J + c] = share
                total[W * (J - 1) + c] += share
        for k in range(K):
            at = W * k + SUMS
            rgb = unclamped(colour, wp.vec3(total[at], total[at + 1], total[at + 2]))
            d_rgb[k, i] = rgb
            if k < J:
                q = W * k
                sums = Moments(total[q], total[q + 1], total[q + 2], total[q + 3], total[q + 4], total[q + 5])
                d_mean, d_quat, d_scale = geometry_vjp(pose, grid, cuts, g, f, scales[i], sums)
                if slopes.shape[0] > 0:
                    d_mean += wp.transpose(slopes[i]) * rgb
                d_means[k, i] = d_mean
                d_quats[k, i] = d_quat
                d_scales[k, i] = d_scale
                d_opacities[k, i] = sums[0] / opacities[i]
        if wp.static(absolute):
            d_absolute[0, i] = wp.vec2(total[W], total[W + 1])

    return project_vjp
