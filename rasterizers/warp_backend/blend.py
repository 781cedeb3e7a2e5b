"""Blend: composites the pixels of a tile front to back; its VJP for K image cotangents runs back to front.

The VJP has a block of threads for every `SEGMENT` pairs, however long a tile's list is. Where a list goes on beyond a segment,
the forward pass leaves a mark for each pixel: T at the segment's end, and the light from behind it.

    α_i = min(α_max, o_i exp(…)),   T_i = Π_{j<i} (1 - α_j),   I = Σ T_i α_i c_i + T_end · background

Expected depth, where it is drawn, is E = Σ T_i α_i z_i / Σ T_i α_i.

A Gaussian with α_i < α_min is skipped; a pixel ends before the Gaussian that would take its T below transmittance_min.
The final T is stored, because 1 - alpha would lose its digits.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from rasterizers.warp_backend.bins import exponent
from rasterizers.warp_backend.types import PIXELS, SEGMENT, SUMS, TILE, Cuts, Ellipse, Grid, Row, ellipse_of

wp.set_module_options({"enable_backward": False})


@wp.func
def pixel_of(tile: wp.int32, within: wp.int32, grid: Grid) -> wp.vec2i:
    """Column and row of a tile's pixel in the image."""
    column, row = tile % grid.tiles[0], tile / grid.tiles[0]
    return wp.vec2i(column * TILE + within % TILE, row * TILE + within / TILE)


@wp.func
def inside(pixel: wp.vec2i, grid: Grid) -> wp.bool:
    """Whether the pixel lies in the image; tiles may extend beyond it."""
    return pixel[0] < grid.size[0] and pixel[1] < grid.size[1]


@wp.func
def offset_of(pixel: wp.vec2i, ellipse: Ellipse) -> wp.vec2:
    """The vector from the ellipse's centre to the pixel's."""
    return wp.vec2(wp.float32(pixel[0]), wp.float32(pixel[1])) - ellipse.whole + (wp.vec2(0.5, 0.5) - ellipse.rest)


@wp.func
def colour(ellipse: Ellipse) -> wp.vec3:
    return wp.max(ellipse.rgb, wp.vec3(0.0, 0.0, 0.0))


@cache
def blend(depth: bool) -> Any:
    """The kernel that draws the image, and with `depth` E, which is 0 where nothing is drawn."""

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        grid: Grid,
        cuts: Cuts,
        rows: wp.array[Row],
        depths: wp.array[wp.float32],
        listed: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        image: wp.array2d[wp.vec3],
        alpha: wp.array2d[wp.float32],
        transmittance: wp.array2d[wp.float32],
        ended: wp.array2d[wp.int32],
        marks: wp.array2d[wp.vec4],
        expected: wp.array2d[wp.float32],
    ) -> None:
        """One thread per pixel. `ended`: the first pair that it did not blend."""
        thread = wp.tid()
        tile, within = thread / PIXELS, thread % PIXELS
        pixel = pixel_of(tile, within, grid)
        if not inside(pixel, grid):
            return
        through, rgb = wp.float32(1.0), wp.vec3(0.0, 0.0, 0.0)
        weighted, weights = wp.float32(0.0), wp.float32(0.0)
        at = wp.int32(starts[tile])
        first_mark, mark = at / SEGMENT + 1, at / SEGMENT
        while at < ends[tile]:
            if at % SEGMENT == 0 and at > starts[tile]:  # rgb is the light of one segment
                mark = at / SEGMENT
                marks[mark, within] = wp.vec4(rgb[0], rgb[1], rgb[2], through)
                rgb = wp.vec3(0.0, 0.0, 0.0)
            ellipse = ellipse_of(rows[listed[at]])
            d = offset_of(pixel, ellipse)
            free = ellipse.opacity * wp.exp(-exponent(ellipse, d[0], d[1]))
            if free >= cuts.alpha_min:
                share = wp.min(free, cuts.alpha_max)
                after = through * (1.0 - share)
                if after < cuts.transmittance_min:
                    break
                weight = through * share
                rgb += weight * colour(ellipse)
                if depth:
                    weighted += weight * depths[listed[at]]
                    weights += weight
                through = after
            at += 1
        rgb += through * cuts.background
        while mark >= first_mark:
            segment = marks[mark, within]
            marks[mark, within] = wp.vec4(rgb[0], rgb[1], rgb[2], segment[3])
            rgb += wp.vec3(segment[0], segment[1], segment[2])
            mark -= 1
        image[pixel[1], pixel[0]] = rgb
        alpha[pixel[1], pixel[0]] = 1.0 - through
        transmittance[pixel[1], pixel[0]] = through
        ended[pixel[1], pixel[0]] = at
        if depth:
            over = wp.float32(0.0)
            if weights > 0.0:
                over = 1.0 / weights
            expected[pixel[1], pixel[0]] = weighted * over

    return blend


@cache
def blend_vjp(K: int, lanes: int) -> Any:
    """The VJP kernel for K cotangents, with `lanes` threads per segment.

    Each lane has `per_lane` pixels. For every pair it sums over its pixels, the lanes' sums are reduced, and the result is
    stored at the pair's place: no atomics, a fixed order. A GPU uses a warp per segment, a CPU one thread.
    """
    per_lane, W = PIXELS // lanes, SUMS + 3
    PairSums = wp.types.vector(length=W * K, dtype=wp.float32)
    Pixels = wp.types.vector(length=per_lane, dtype=wp.float32)
    Ends = wp.types.vector(length=per_lane, dtype=wp.int32)
    Behind = wp.types.matrix(shape=(per_lane, K), dtype=wp.float32)
    Cotangents = wp.types.matrix(shape=(per_lane * K, 3), dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def blend_vjp(
        grid: Grid,
        cuts: Cuts,
        rows: wp.array[Row],
        tiles: wp.array[wp.int32],
        listed: wp.array[wp.int32],
        places: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        transmittance: wp.array2d[wp.float32],
        ended: wp.array2d[wp.int32],
        marks: wp.array2d[wp.vec4],
        cotangents: wp.array3d[wp.vec3],
        pairs: wp.int32,
        pair_sums: wp.array[PairSums],
    ) -> None:
        segment, lane = wp.tid()
        tile, n_tiles, after = wp.int32(-1), grid.tiles[0] * grid.tiles[1], (segment + 1) * SEGMENT
        through, stop, behind, v = Pixels(), Ends(), Behind(), Cotangents()
        last = wp.min(after, pairs)
        for back in range(last - segment * SEGMENT):
            at = last - 1 - back
            if tiles[at] != tile:
                tile = tiles[at]
                for j in range(per_lane):
                    within = j * lanes + lane
                    pixel = pixel_of(tile, within, grid)
                    through[j] = 0.0
                    stop[j] = 0
                    if tile < n_tiles and inside(pixel, grid):
                        through[j] = transmittance[pixel[1], pixel[0]]
                        stop[j] = ended[pixel[1], pixel[0]]
                        light = through[j] * cuts.background
                        if ends[tile] > after and stop[j] > after:
                            mark = marks[segment + 1, within]
                            through[j] = mark[3]
                            light = wp.vec3(mark[0], mark[1], mark[2])
                        for k in range(K):
                            w = cotangents[k, pixel[1], pixel[0]]
                            v[j * K + k] = w
                            # Σ_{j>i} T_j α_j (c_j·v) + T_end background·v, here with i the last Gaussian.
                            behind[j, k] = wp.dot(w, light)

            ellipse = Ellipse()
            if tile < n_tiles:
                ellipse = ellipse_of(rows[listed[at]])
            part = PairSums()
            for j in range(per_lane):
                d = offset_of(pixel_of(tile, j * lanes + lane, grid), ellipse)
                free = ellipse.opacity * wp.exp(-exponent(ellipse, d[0], d[1]))
                if at < stop[j] and free >= cuts.alpha_min:
                    share = wp.min(free, cuts.alpha_max)
                    over = 1.0 / (1.0 - share)
                    through[j] = through[j] * over
                    weight = through[j] * share
                    rgb = colour(ellipse)
                    for k in range(K):
                        light_k = wp.dot(v[j * K + k], rgb)
                        if free <= cuts.alpha_max:  # where α is capped, the image does not depend on the ellipse
                            q = share * (through[j] * light_k - behind[j, k] * over)
                            part[W * k] += q
                            part[W * k + 1] += q * d[0]
                            part[W * k + 2] += q * d[1]
                            part[W * k + 3] += q * d[0] * d[0]
                            part[W * k + 4] += q * d[0] * d[1]
                            part[W * k + 5] += q * d[1] * d[1]
                        for c in range(3):
                            part[W * k + SUMS + c] += weight * v[j * K + k, c]
                        behind[j, k] = behind[j, k] + weight * light_k
            wp.tile_store(pair_sums, wp.tile_sum(wp.tile(part, preserve_type=True)), offset=(places[at],))

    return blend_vjp
