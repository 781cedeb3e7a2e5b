"""Blend: composites the pixels of a tile front to back; its VJP for K image cotangents runs back to front.

    α_i = min(α_max, o_i exp(…)),   T_i = Π_{j<i} (1 - α_j),   I = Σ T_i α_i c_i + T_end · background

Expected depth, where it is drawn, is E = Σ T_i α_i z_i / Σ T_i α_i.

A Gaussian with α_i < α_min is skipped; a pixel ends before the Gaussian that would take its T below transmittance_min.
The final T is stored, because 1 - alpha would lose its digits.

The VJP has a block of threads for every `SEGMENT` pairs, however long a tile's list is. Where a list goes on beyond a segment,
the forward pass leaves a mark for each pixel: T at the segment's end, and the light from behind it.

Both read the Gaussians in batches: each thread of a block loads one, and all threads use them from shared memory. Batches
alternate between two halves of it, so that a thread may load the next batch while others use this one.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import warp as wp

from rasterizers.warp_backend.bins import exponent
from rasterizers.warp_backend.types import PIXELS, SEGMENT, SUMS, TILE, Cuts, Grid, Row, ellipse_of

wp.set_module_options({"enable_backward": False})

Near: Final[Any] = wp.types.vector(length=9, dtype=wp.float32)
"""A Gaussian as a tile's pixels see it: its centre from the tile's first pixel, px; A, B and C; opacity; colour."""


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
def near(row: Row, tile: wp.int32, grid: Grid) -> Near:
    ellipse, first = ellipse_of(row), pixel_of(tile, 0, grid)
    centre = ellipse.whole - wp.vec2(wp.float32(first[0]), wp.float32(first[1])) + (ellipse.rest - wp.vec2(0.5, 0.5))
    rgb = wp.max(ellipse.rgb, wp.vec3(0.0, 0.0, 0.0))
    return Near(centre[0], centre[1], ellipse.A, ellipse.B, ellipse.C, ellipse.opacity, rgb[0], rgb[1], rgb[2])


@wp.func
def offset_of(within: wp.int32, g: Near) -> wp.vec2:
    """The vector from the Gaussian's centre to the pixel's."""
    return wp.vec2(wp.float32(within % TILE) - g[0], wp.float32(within / TILE) - g[1])


@wp.func
def alpha_of(g: Near, d: wp.vec2) -> wp.float32:
    """α before its cap."""
    return g[5] * wp.exp(-exponent(g[2], g[3], g[4], d[0], d[1]))


@cache
def blend(depth: bool, lanes: int) -> Any:  # noqa: PLR0915 - a kernel
    """The kernel that draws the image, with `lanes` threads per tile; with `depth` also E, which is 0 where nothing is drawn."""
    per_lane, both = PIXELS // lanes, 2 * lanes
    Numbers = wp.types.vector(length=per_lane, dtype=wp.float32)
    Ends = wp.types.vector(length=per_lane, dtype=wp.int32)
    Colours = wp.types.matrix(shape=(per_lane, 3), dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def blend(  # noqa: PLR0912, PLR0915
        grids: wp.array[Grid],
        cuts: Cuts,
        backgrounds: wp.array[wp.vec3],
        rows: wp.array[Row],
        depths: wp.array[wp.float32],
        listed: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        image: wp.array2d[wp.vec3],
        transmittance: wp.array2d[wp.float32],
        ended: wp.array2d[wp.int32],
        marks: wp.array2d[wp.vec4],
        expected: wp.array2d[wp.float32],
    ) -> None:
        """`ended` receives the first pair that the pixel did not blend."""
        tile, lane = wp.tid()
        grid, background = grids[0], backgrounds[0]
        begin, end = starts[tile], ends[tile]
        batch = wp.tile_empty(shape=(both,), dtype=Near, storage="shared")
        through, stop, light, weighted, weights = Numbers(), Ends(), Colours(), Numbers(), Numbers()
        for j in range(per_lane):
            through[j] = 1.0
            stop[j] = end
            if not inside(pixel_of(tile, j * lanes + lane, grid), grid):
                stop[j] = begin
        half = wp.int32(0)
        for first in range(begin, end, lanes):
            loaded = Near()
            if first + lane < end:
                loaded = near(rows[listed[first + lane]], tile, grid)
            wp.tile_assign(batch, wp.tile(loaded, preserve_type=True), offset=(half,))
            for nth in range(wp.min(lanes, end - first)):
                at, g = first + nth, batch[half + nth]
                for j in range(per_lane):
                    within = j * lanes + lane
                    if at < stop[j]:
                        if at % SEGMENT == 0 and at > begin:  # light is that of one segment
                            marks[at / SEGMENT, within] = wp.vec4(light[j, 0], light[j, 1], light[j, 2], through[j])
                            for c in range(3):
                                light[j, c] = 0.0
                        free = alpha_of(g, offset_of(within, g))
                        if free >= cuts.alpha_min:
                            share = wp.min(free, cuts.alpha_max)
                            after = through[j] * (1.0 - share)
                            if after < cuts.transmittance_min:
                                stop[j] = at
                            else:
                                weight = through[j] * share
                                for c in range(3):
                                    light[j, c] += weight * g[6 + c]
                                if depth:
                                    weighted[j] += weight * depths[listed[at]]
                                    weights[j] += weight
                                through[j] = after
            half = lanes - half
        for j in range(per_lane):
            within = j * lanes + lane
            pixel = pixel_of(tile, within, grid)
            if inside(pixel, grid):
                rgb = wp.vec3(light[j, 0], light[j, 1], light[j, 2]) + through[j] * background
                last = wp.min(stop[j], end - 1) / SEGMENT
                for back in range(wp.max(last - begin / SEGMENT, 0)):
                    mark = last - back
                    segment = marks[mark, within]
                    marks[mark, within] = wp.vec4(rgb[0], rgb[1], rgb[2], segment[3])
                    rgb += wp.vec3(segment[0], segment[1], segment[2])
                image[pixel[1], pixel[0]] = rgb
                transmittance[pixel[1], pixel[0]] = through[j]
                ended[pixel[1], pixel[0]] = stop[j]
                if depth:
                    over = wp.float32(0.0)
                    if weights[j] > 0.0:
                        over = 1.0 / weights[j]
                    expected[pixel[1], pixel[0]] = weighted[j] * over

    return blend


@cache
def warp_sum(width: int) -> Any:
    """The function that adds up the vectors of the 32 lanes of a warp and stores the sum as row `place`, on CUDA.

    In each of five rounds a lane keeps half of its numbers and gets its partner's of the same half, so that 18 numbers take 20
    shuffles, where sums of one number after the other take 90. A lane ends with one number, or with none.
    """
    lines, size = [f"float x[{width}]; for (int k = 0; k < {width}; ++k) x[k] = part[k];"], width
    lines += [f"const int lane = threadIdx.x & 31; int first = 0, size = {width}; bool upper;"]
    for bit in (16, 8, 4, 2, 1):
        half = (size + 1) // 2
        lines += [
            f"upper = lane & {bit}; first += upper ? {half} : 0; size = upper ? size - {half} : min(size, {half});"
        ]
        for k in range(half):
            low, high = f"x[{k}]", f"x[{half + k}]" if half + k < size else "0.0f"
            lines += [f"{low} = (upper ? {high} : {low}) + __shfl_xor_sync(0xffffffff, upper ? {low} : {high}, {bit});"]
        size = half
    lines += [f"if (size > 0) sums.data[size_t(place) * {width} + first] = x[0];"]
    source = "\n".join(("", "#if defined(__CUDA_ARCH__)", *lines, "#endif", ""))

    def warp_sum(part, place, sums): ...  # type: ignore[no-untyped-def]

    part = wp.types.vector(length=width, dtype=wp.float32)
    warp_sum.__annotations__ = {"part": part, "place": wp.int32, "sums": wp.array2d[wp.float32]}
    return wp.func_native(source)(warp_sum)


@cache
def blend_vjp(K: int, lanes: int, shuffles: bool) -> Any:  # noqa: PLR0915 - a kernel
    """The VJP kernel for K cotangents, with `lanes` threads per segment.

    Each lane has `per_lane` pixels. For every pair it sums over its pixels, the lanes' sums are added up, and the result is
    stored at the pair's place: no atomics, a fixed order. A GPU uses a warp per segment, a CPU one thread.

    Args:
        shuffles: add up by `warp_sum`.
    """
    per_lane, both, W = PIXELS // lanes, 2 * lanes, SUMS + 3
    PairSums = wp.types.vector(length=W * K, dtype=wp.float32)
    Pixels = wp.types.vector(length=per_lane, dtype=wp.float32)
    Ends = wp.types.vector(length=per_lane, dtype=wp.int32)
    Behind = wp.types.matrix(shape=(per_lane, K), dtype=wp.float32)
    Cotangents = wp.types.matrix(shape=(per_lane * K, 3), dtype=wp.float32)
    store = warp_sum(W * K)

    @wp.kernel(module="unique", enable_backward=False)
    def blend_vjp(  # noqa: PLR0912, PLR0915
        grids: wp.array[Grid],
        cuts: Cuts,
        backgrounds: wp.array[wp.vec3],
        rows: wp.array[Row],
        tiles: wp.array[wp.int32],
        listed: wp.array[wp.int32],
        places: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        transmittance: wp.array2d[wp.float32],
        ended: wp.array2d[wp.int32],
        marks: wp.array2d[wp.vec4],
        cotangents: wp.array3d[wp.vec3],
        total: wp.array[wp.int64],
        pair_sums: wp.array2d[wp.float32],
    ) -> None:
        segment, lane = wp.tid()
        grid, background, pairs = grids[0], backgrounds[0], wp.int32(total[0])
        tile, n_tiles, after = wp.int32(-1), grid.tiles[0] * grid.tiles[1], (segment + 1) * SEGMENT
        batch = wp.tile_empty(shape=(both,), dtype=Near, storage="shared")
        where = wp.tile_empty(shape=(both,), dtype=wp.vec2i, storage="shared")
        through, stop, behind, v = Pixels(), Ends(), Behind(), Cotangents()
        last, half = wp.min(after, pairs), wp.int32(0)
        for done in range(0, last - segment * SEGMENT, lanes):
            loaded, found = Near(), wp.vec2i(n_tiles, 0)
            mine = last - 1 - done - lane
            if mine >= segment * SEGMENT:
                found = wp.vec2i(tiles[mine], places[mine])
                if found[0] < n_tiles:
                    loaded = near(rows[listed[mine]], found[0], grid)
            wp.tile_assign(batch, wp.tile(loaded, preserve_type=True), offset=(half,))
            wp.tile_assign(where, wp.tile(found, preserve_type=True), offset=(half,))
            for nth in range(wp.min(lanes, last - segment * SEGMENT - done)):
                at, g, tile_and_place = last - 1 - done - nth, batch[half + nth], where[half + nth]
                if tile_and_place[0] != tile:
                    tile = tile_and_place[0]
                    for j in range(per_lane):
                        within = j * lanes + lane
                        pixel = pixel_of(tile, within, grid)
                        stop[j] = 0
                        if tile < n_tiles and inside(pixel, grid):
                            through[j] = transmittance[pixel[1], pixel[0]]
                            stop[j] = ended[pixel[1], pixel[0]]
                            light = through[j] * background
                            if ends[tile] > after and stop[j] > after:
                                mark = marks[segment + 1, within]
                                through[j] = mark[3]
                                light = wp.vec3(mark[0], mark[1], mark[2])
                            for k in range(K):
                                w = cotangents[k, pixel[1], pixel[0]]
                                v[j * K + k] = w
                                # Σ_{j>i} T_j α_j (c_j·v) + T_end background·v, here with i the last Gaussian.
                                behind[j, k] = wp.dot(w, light)

                part = PairSums()
                for j in range(per_lane):
                    d = offset_of(j * lanes + lane, g)
                    free = alpha_of(g, d)
                    if at < stop[j] and free >= cuts.alpha_min:
                        share = wp.min(free, cuts.alpha_max)
                        over = 1.0 / (1.0 - share)
                        through[j] = through[j] * over
                        weight = through[j] * share
                        rgb = wp.vec3(g[6], g[7], g[8])
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
                if shuffles:
                    store(part, tile_and_place[1], pair_sums)
                else:
                    whole = wp.tile_sum(wp.tile(part, preserve_type=True))
                    sums = whole[0]
                    for c in range(lane, W * K, lanes):
                        pair_sums[tile_and_place[1], c] = sums[c]
            half = lanes - half

    return blend_vjp
