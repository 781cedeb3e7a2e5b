"""Project: every Gaussian onto a screen, with its colour; and the sums of the pixels back to its tensors."""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from rasterizers.warp_backend.bins import count_tiles, depth_key, reaches_image
from rasterizers.warp_backend.colour import colour_of
from rasterizers.warp_backend.geometry import (
    Footprint,
    Sums,
    centre_of,
    footprint_of,
    geometry_of,
    geometry_vjp,
)
from rasterizers.warp_backend.types import FAR, Cuts, Ellipse, Pose, Row, Screen, ellipse_of, row_of

wp.set_module_options({"enable_backward": False})

HUGE = wp.constant(1e30)  # an ellipse of 1e-15 px covers no pixel centre, and its square would overflow


@wp.func
def ellipse_at(u: wp.float64, v: wp.float64, f: Footprint, opacity: wp.float32, cuts: Cuts) -> Ellipse:
    whole_u, whole_v = wp.round(u), wp.round(v)
    ellipse = Ellipse()
    ellipse.whole = wp.vec2(wp.float32(whole_u), wp.float32(whole_v))
    ellipse.rest = wp.vec2(wp.float32(u - whole_u), wp.float32(v - whole_v))
    ellipse.A = 0.5 * f.xx
    ellipse.B = f.xy
    ellipse.C = 0.5 * f.yy
    ellipse.opacity = opacity * f.compensation
    ellipse.reach = wp.log(wp.max(ellipse.opacity, 1e-30) / cuts.alpha_min) * 1.001 + 1e-3
    extent = wp.sqrt(2.0 * wp.max(ellipse.reach, 0.0)) * f.size
    ellipse.half = extent * wp.vec2(wp.sqrt(f.a + f.kernel), wp.sqrt(f.c + f.kernel))
    return ellipse


@wp.func
def shows(ellipse: Ellipse, screen: Screen) -> wp.bool:
    """Conditions to keep, not to cull: NaN fails each."""
    seen = ellipse.reach > 0.0 and ellipse.A < HUGE and ellipse.C < HUGE
    seen = seen and wp.abs(ellipse.whole[0]) < HUGE and wp.abs(ellipse.whole[1]) < HUGE
    seen = seen and ellipse.half[0] >= 0.0 and ellipse.half[1] >= 0.0
    if not seen:
        return False
    return reaches_image(ellipse, screen)


@wp.func
def finite(v: wp.vec3) -> wp.bool:
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.kernel
def project(
    pose: Pose,
    screen: Screen,
    cuts: Cuts,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    sh0: wp.array[wp.vec3],
    shN: wp.array2d[wp.vec3],
    moved: wp.bool,
    offsets: wp.array[wp.vec3],
    masked: wp.bool,
    wanted: wp.array2d[wp.bool],
    first: wp.bool,
    keys: wp.array[wp.int32],
    colours: wp.array[wp.vec3],
    slopes: wp.array[wp.mat33],
    rows: wp.array[Row],
    means2d: wp.array[wp.vec2],
    visible: wp.array[wp.bool],
    counts: wp.array[wp.int32],
    poison: wp.array[wp.int64],
) -> None:
    """A thread per Gaussian. What the screens of a pose share (depth key, colour, slope) is made by the first that draws it.

    `poison` becomes 1 if a number that was needed is not finite.
    """
    i = wp.tid()
    quat, opacity = quats[i], opacities[i]
    sound = finite(means[i]) and finite(scales[i]) and wp.isfinite(opacity)
    sound = sound and wp.isfinite(quat[0]) and wp.isfinite(quat[1]) and wp.isfinite(quat[2]) and wp.isfinite(quat[3])
    if first:
        keys[i] = FAR
    means2d[i] = wp.vec2(0.0, 0.0)
    visible[i] = False
    counts[i] = 0

    centre = centre_of(pose, means[i])
    if centre.z > cuts.near:
        u = screen.exact_focal[0] * centre.tan[0] + screen.exact_principal[0]
        v = screen.exact_focal[1] * centre.tan[1] + screen.exact_principal[1]
        means2d[i] = wp.vec2(wp.float32(u), wp.float32(v))
        if opacity >= cuts.alpha_min:
            footprint = footprint_of(geometry_of(pose, screen, centre, quat, scales[i]), screen, cuts)
            ellipse = ellipse_at(u, v, footprint, opacity, cuts)
            if shows(ellipse, screen):
                visible[i] = True
                count = count_tiles(ellipse, screen, masked, wanted)
                if count > 0:
                    counts[i] = count
                    if keys[i] == FAR:
                        keys[i] = depth_key(centre.z, cuts)
                        rgb, slope = colour_of(means[i], pose.center, sh0[i], shN, i)
                        colours[i] = rgb
                        if shN.shape[1] > 0:
                            slopes[i] = slope
                    ellipse.rgb = colours[i]
                    if moved:
                        ellipse.rgb += offsets[i]
                    rows[i] = row_of(ellipse)
                    sound = sound and finite(ellipse.rgb)
    if not sound:
        poison[0] = wp.int64(1)


@cache
def pull(K: int) -> Any:
    """The kernel that brings K cotangents' sums to the tensors."""
    Sent = wp.types.vector(length=9 * K, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def pull(
        pose: Pose,
        screen: Screen,
        cuts: Cuts,
        means: wp.array[wp.vec3],
        quats: wp.array[wp.vec4],
        scales: wp.array[wp.vec3],
        opacities: wp.array[wp.float32],
        slopes: wp.array[wp.mat33],
        turns: wp.bool,
        rows: wp.array[Row],
        counts: wp.array[wp.int32],
        firsts: wp.array[wp.int32],
        sent: wp.array[Sent],
        d_means: wp.array2d[wp.vec3],
        d_quats: wp.array2d[wp.vec4],
        d_scales: wp.array2d[wp.vec3],
        d_opacities: wp.array2d[wp.float32],
        d_screen: wp.array2d[wp.vec2],
        d_rgb: wp.array2d[wp.vec3],
    ) -> None:
        """A thread per Gaussian: adds what its tiles sent, in their order, and takes it through the projection."""
        i = wp.tid()
        if counts[i] == 0:
            for k in range(K):
                d_means[k, i] = wp.vec3(0.0, 0.0, 0.0)
                d_quats[k, i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
                d_scales[k, i] = wp.vec3(0.0, 0.0, 0.0)
                d_opacities[k, i] = 0.0
                d_screen[k, i] = wp.vec2(0.0, 0.0)
                d_rgb[k, i] = wp.vec3(0.0, 0.0, 0.0)
            return
        total = Sent()
        for nth in range(counts[i]):
            total += sent[firsts[i] + nth]
        g = geometry_of(pose, screen, centre_of(pose, means[i]), quats[i], scales[i])
        f = footprint_of(g, screen, cuts)
        ellipse = ellipse_of(rows[i])
        for k in range(K):
            sums = Sums()
            sums.q = total[9 * k]
            sums.first = wp.vec2(total[9 * k + 1], total[9 * k + 2])
            sums.xx = total[9 * k + 3]
            sums.xy = total[9 * k + 4]
            sums.yy = total[9 * k + 5]
            out = geometry_vjp(pose, screen, cuts, g, f, scales[i], sums)
            rgb = wp.vec3(0.0, 0.0, 0.0)
            for c in range(3):
                if ellipse.rgb[c] >= 0.0:  # where the clamp binds the picture does not depend on the colour
                    rgb[c] = total[9 * k + 6 + c]
            if turns:
                out.mean += wp.transpose(slopes[i]) * rgb
            d_means[k, i] = out.mean
            d_quats[k, i] = out.quat
            d_scales[k, i] = out.scale
            d_opacities[k, i] = sums.q / opacities[i]
            d_screen[k, i] = out.screen
            d_rgb[k, i] = rgb

    return pull
