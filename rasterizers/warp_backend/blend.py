"""Blend: composites the pixels of a tile front to back; its VJP for K image cotangents runs back to front.

    α_i = min(α_max, o_i exp(…)),   T_i = Π_{j<i} (1 - α_j),   I = Σ T_i α_i c_i + T_end · background

Expected depth, where it is drawn, is E = Σ T_i α_i z_i / Σ T_i α_i.

A Gaussian with α_i < α_min is skipped; a pixel ends before the Gaussian that would take its T below transmittance_min.
The final T is stored, because 1 - alpha would lose its digits.

Both directions have a block of threads for every `SEGMENT` pairs, however long a tile's list is. A tile's part of a segment is a
piece. Forward, each piece is blended alone, as if T were 1 before it, and then the pieces of a tile one after the other; at the
start of each a mark is left for each pixel: T there, and the light from behind it.

Pairs are read in batches: each thread of a block loads one, and all threads use them from shared memory. Batches alternate
between two halves of it, so that a thread may load the next batch while others use this one.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import warp as wp

from rasterizers.warp_backend.bins import exponent
from rasterizers.warp_backend.sizes import SEGMENT, TILE
from rasterizers.warp_backend.types import PIXELS, SUMS, Cuts, Ellipse, Grid, Moments, width_of

wp.set_module_options({"enable_backward": False})

Near: Final[Any] = wp.types.vector(length=9, dtype=wp.float32)
"""A Gaussian as a tile's pixels see it: its centre from the tile's first pixel, px; A, S and D; opacity; colour."""


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
def near(pair: wp.int32, tile: wp.int32, listed: wp.array[wp.int32], ellipses: wp.array[Ellipse], grid: Grid) -> Near:
    """The Gaussian of a pair."""
    ellipse, first = ellipses[listed[pair]], pixel_of(tile, 0, grid)
    centre = ellipse.whole - wp.vec2(wp.float32(first[0]), wp.float32(first[1])) + (ellipse.rest - wp.vec2(0.5, 0.5))
    rgb = wp.max(ellipse.rgb, wp.vec3(0.0, 0.0, 0.0))
    return Near(centre[0], centre[1], ellipse.A, ellipse.S, ellipse.D, ellipse.opacity, rgb[0], rgb[1], rgb[2])


@wp.func
def offset_of(within: wp.int32, g: Near) -> wp.vec2:
    """(u, dy) of `Ellipse` of a pixel."""
    dy = wp.float32(within / TILE) - g[1]
    return wp.vec2(wp.float32(within % TILE) - g[0] + g[3] * dy, dy)


@wp.func
def alpha_of(g: Near, d: wp.vec2) -> wp.float32:
    """α before its cap."""
    return g[5] * wp.exp(-exponent(g[2], g[4], d[0], d[1]))


@wp.func
def piece_of(segment: wp.int32, tile: wp.int32) -> wp.int32:
    """The number of the piece that a tile has in a segment: pairs are sorted by tile, so that each has another."""
    return segment + tile


@wp.func
def loaded(
    pair: wp.int32, first: wp.int32, last: wp.int32, tiles: wp.array[wp.int32], listed: wp.array[wp.int32],
    ellipses: wp.array[Ellipse], grid: Grid,
) -> tuple[wp.int32, Near]:  # fmt: skip
    """The tile of a pair, or the number of tiles where the pair is not in [first, last), and its Gaussian."""
    n_tiles = grid.tiles[0] * grid.tiles[1]
    if pair < first or pair >= last:
        return n_tiles, Near()
    tile = tiles[pair]
    if tile >= n_tiles:
        return n_tiles, Near()
    return tile, near(pair, tile, listed, ellipses, grid)


@cache
def blend_pieces(depth: bool, lanes: int) -> Any:
    """The kernel that blends each segment as if nothing lay before it, with `lanes` threads per segment."""
    per_lane, both = PIXELS // lanes, 2 * lanes
    Lights = wp.types.matrix(shape=(per_lane, 4), dtype=wp.float32)
    Depths = wp.types.matrix(shape=(per_lane, 2), dtype=wp.float32)

    @wp.func
    def keep(
        piece: wp.int32, lane: wp.int32, light: Any, sums: Any, pieces: wp.array2d[wp.vec4], expected: wp.array2d[wp.vec2]
    ) -> None:  # fmt: skip
        for j in range(per_lane):
            pieces[piece, j * lanes + lane] = wp.vec4(light[j, 0], light[j, 1], light[j, 2], light[j, 3])
            if depth:
                expected[piece, j * lanes + lane] = wp.vec2(sums[j, 0], sums[j, 1])

    @wp.kernel(module="unique", enable_backward=False)
    def blend_pieces(
        grids: wp.array[Grid],
        cuts: Cuts,
        ellipses: wp.array[Ellipse],
        depths: wp.array[wp.float32],
        tiles: wp.array[wp.int32],
        listed: wp.array[wp.int32],
        total: wp.array[wp.int64],
        capacity: wp.int32,
        pieces: wp.array2d[wp.vec4],
        expected: wp.array2d[wp.vec2],
    ) -> None:
        """`pieces` receives light and transmittance, and `expected` the sums of E, see `piece_of`."""
        segment, lane = wp.tid()
        grid, first = grids[0], segment * SEGMENT
        n_tiles, pairs = grid.tiles[0] * grid.tiles[1], wp.int32(wp.min(total[0], wp.int64(capacity)))
        last = wp.min(first + SEGMENT, pairs)
        batch = wp.tile_empty(shape=(both,), dtype=Near, storage="shared")
        tile_of = wp.tile_empty(shape=(both,), dtype=wp.int32, storage="shared")
        light, sums, tile, half = Lights(), Depths(), wp.int32(n_tiles), wp.int32(0)
        for start in range(first, last, lanes):
            found, gaussian = loaded(start + lane, first, last, tiles, listed, ellipses, grid)
            wp.tile_assign(batch, wp.tile(gaussian, preserve_type=True), offset=(half,))
            wp.tile_assign(tile_of, wp.tile(found), offset=(half,))
            for nth in range(wp.min(lanes, last - start)):
                g = batch[half + nth]
                if tile_of[half + nth] != tile:
                    if tile < n_tiles:
                        keep(piece_of(segment, tile), lane, light, sums, pieces, expected)
                    tile = tile_of[half + nth]
                    light, sums = Lights(), Depths()
                    for j in range(per_lane):
                        light[j, 3] = 1.0
                for j in range(per_lane):
                    free = alpha_of(g, offset_of(j * lanes + lane, g))
                    if free >= cuts.alpha_min:
                        share = wp.min(free, cuts.alpha_max)
                        weight = light[j, 3] * share
                        for c in range(3):
                            light[j, c] += weight * g[6 + c]
                        if depth:
                            sums[j, 0] += weight * depths[listed[start + nth]]
                            sums[j, 1] += weight
                        light[j, 3] *= 1.0 - share
            half = lanes - half
        if tile < n_tiles:
            keep(piece_of(segment, tile), lane, light, sums, pieces, expected)

    return blend_pieces


@wp.func
def blend_to_end(
    first: wp.int32, last: wp.int32, end: wp.int32, tile: wp.int32, within: wp.int32, through: wp.float32, sums: wp.vec2,
    depth: wp.bool, cuts: Cuts, ellipses: wp.array[Ellipse], depths: wp.array[wp.float32], listed: wp.array[wp.int32], grid: Grid,
) -> tuple[wp.int32, wp.float32, wp.vec3, wp.vec2]:  # fmt: skip
    """Blend the piece in which a pixel ends pair by pair. Returns the first pair that is not blended, T, light, the sums of E."""
    stop, light = wp.int32(end), wp.vec3()
    for pair in range(first, last):
        if stop == end:
            g = near(pair, tile, listed, ellipses, grid)
            free = alpha_of(g, offset_of(within, g))
            if free >= cuts.alpha_min:
                share = wp.min(free, cuts.alpha_max)
                after = through * (1.0 - share)
                if after < cuts.transmittance_min:
                    stop = pair
                else:
                    weight = through * share
                    light += weight * wp.vec3(g[6], g[7], g[8])
                    if depth:
                        sums += weight * wp.vec2(depths[listed[pair]], 1.0)
                    through = after
    return stop, through, light, sums


@cache
def blend(depth: bool) -> Any:
    """The kernel that draws the image of pieces; with `depth` also E, which is 0 where nothing is drawn."""

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        grids: wp.array[Grid],
        cuts: Cuts,
        backgrounds: wp.array[wp.vec3],
        ellipses: wp.array[Ellipse],
        depths: wp.array[wp.float32],
        listed: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        pieces: wp.array2d[wp.vec4],
        sums_of_pieces: wp.array2d[wp.vec2],
        image: wp.array2d[wp.vec3],
        transmittance: wp.array2d[wp.float32],
        ended: wp.array2d[wp.int32],
        expected: wp.array2d[wp.float32],
    ) -> None:
        """One thread per pixel of a tile. `ended` receives the first pair that the pixel did not blend, and a piece the mark of
        its start: the light from behind, and T.
        """
        tile, within = wp.tid()
        grid = grids[0]
        pixel = pixel_of(tile, within, grid)
        if not inside(pixel, grid):
            return
        begin, end = starts[tile], ends[tile]
        first, stop, last = begin / SEGMENT, wp.int32(end), begin / SEGMENT
        through, light, sums = wp.float32(1.0), wp.vec3(), wp.vec2()
        for segment in range(first, (end + SEGMENT - 1) / SEGMENT):
            if stop == end:
                at, last = piece_of(segment, tile), segment
                piece = pieces[at, within]
                # The light is that of the segment before.
                pieces[at, within] = wp.vec4(light[0], light[1], light[2], through)
                after = through * piece[3]
                if after >= cuts.transmittance_min:
                    light = through * wp.vec3(piece[0], piece[1], piece[2])
                    if depth:
                        sums += through * sums_of_pieces[at, within]
                    through = after
                else:
                    low, high = wp.max(segment * SEGMENT, begin), wp.min((segment + 1) * SEGMENT, end)
                    stop, through, light, sums = blend_to_end(
                        low, high, end, tile, within, through, sums, depth, cuts, ellipses, depths, listed, grid
                    )
        rgb = light + through * backgrounds[0]
        for back in range(last - first):
            at = piece_of(last - back, tile)
            before = pieces[at, within]
            pieces[at, within] = wp.vec4(rgb[0], rgb[1], rgb[2], before[3])
            rgb += wp.vec3(before[0], before[1], before[2])
        image[pixel[1], pixel[0]] = rgb
        transmittance[pixel[1], pixel[0]] = through
        ended[pixel[1], pixel[0]] = stop
        if depth:
            over = wp.float32(0.0)
            if sums[1] > 0.0:
                over = 1.0 / sums[1]
            expected[pixel[1], pixel[0]] = sums[0] * over

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


@wp.func
def moments_of(q: wp.float32, d: wp.vec2) -> Moments:
    """The sums of a pair of which the geometry's gradients are made, of one pixel at d."""
    return Moments(q, q * d[0], q * d[1], q * d[0] * d[0], q * d[0] * d[1], q * d[1] * d[1])


@cache
def blend_vjp(K: int, lanes: int, shuffles: bool, absolute: bool = False) -> Any:  # noqa: PLR0915 - a kernel
    """The VJP kernel for K cotangents, with `lanes` threads per segment.

    Each lane has `per_lane` pixels. For every pair it sums over its pixels, the lanes' sums are added up, and the result is
    stored at the pair's place: no atomics, a fixed order. A GPU uses a warp per segment, a CPU one thread.

    Args:
        shuffles: add up by `warp_sum`. absolute: also Σ|∂L/∂u| over the pixels, for one cotangent.
    """
    per_lane, both, W, width = PIXELS // lanes, 2 * lanes, SUMS + 3, width_of(K, absolute)
    PairSums = wp.types.vector(length=width, dtype=wp.float32)
    Pixels = wp.types.vector(length=per_lane, dtype=wp.float32)
    Ends = wp.types.vector(length=per_lane, dtype=wp.int32)
    Behind = wp.types.matrix(shape=(per_lane, K), dtype=wp.float32)
    Cotangents = wp.types.matrix(shape=(per_lane * K, 3), dtype=wp.float32)
    store = warp_sum(width)

    @wp.kernel(module="unique", enable_backward=False)
    def blend_vjp(  # noqa: PLR0912, PLR0915
        grids: wp.array[Grid],
        cuts: Cuts,
        backgrounds: wp.array[wp.vec3],
        ellipses: wp.array[Ellipse],
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
        tile, n_tiles, first = wp.int32(-1), grid.tiles[0] * grid.tiles[1], segment * SEGMENT
        batch = wp.tile_empty(shape=(both,), dtype=Near, storage="shared")
        where = wp.tile_empty(shape=(both,), dtype=wp.vec2i, storage="shared")
        through, stop, behind, v = Pixels(), Ends(), Behind(), Cotangents()
        last, half = wp.min(first + SEGMENT, pairs), wp.int32(0)
        for done in range(0, last - first, lanes):
            mine, place = last - 1 - done - lane, wp.int32(0)
            found, gaussian = loaded(mine, first, last, tiles, listed, ellipses, grid)
            if mine >= first:
                place = places[mine]
            wp.tile_assign(batch, wp.tile(gaussian, preserve_type=True), offset=(half,))
            wp.tile_assign(where, wp.tile(wp.vec2i(found, place), preserve_type=True), offset=(half,))
            for nth in range(wp.min(lanes, last - first - done)):
                at, g, tile_and_place = last - 1 - done - nth, batch[half + nth], where[half + nth]
                if tile_and_place[0] != tile:
                    tile = tile_and_place[0]
                    for j in range(per_lane):
                        within = j * lanes + lane
                        pixel = pixel_of(tile, within, grid)
                        stop[j] = 0
                        if tile < n_tiles and inside(pixel, grid):
                            stop[j] = ended[pixel[1], pixel[0]]
                            through[j] = transmittance[pixel[1], pixel[0]]
                            light = through[j] * background
                            if wp.min(ends[tile], stop[j]) > first + SEGMENT:
                                mark = marks[piece_of(segment + 1, tile), within]
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
                                moments = moments_of(q, d)
                                for m in range(SUMS):
                                    part[W * k + m] += moments[m]
                                if wp.static(absolute):
                                    along = 2.0 * g[2] * d[0]
                                    part[W] += wp.abs(q * along)
                                    part[W + 1] += wp.abs(q * (g[3] * along + 2.0 * g[4] * d[1]))
                            for c in range(3):
                                part[W * k + SUMS + c] += weight * v[j * K + k, c]
                            behind[j, k] = behind[j, k] + weight * light_k
                if shuffles:
                    store(part, tile_and_place[1], pair_sums)
                else:
                    whole = wp.tile_sum(wp.tile(part, preserve_type=True))
                    sums = whole[0]
                    for c in range(lane, width, lanes):
                        pair_sums[tile_and_place[1], c] = sums[c]
            half = lanes - half

    return blend_vjp
