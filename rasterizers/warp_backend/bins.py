"""Bin: which Gaussian may touch which tile of 8 x 8 pixels, front to back.

Gaussians are sorted by depth once for all screens of a pose, and only they: what is sorted by tile afterwards, stably,
already comes in that order. A Gaussian's pairs lie side by side where they were listed, in the order of its tiles; there
the way back leaves what each tile sends, so that its sums have one order.
"""

from __future__ import annotations

import warp as wp

from rasterizers.warp_backend.types import FAR, TILE, Cuts, Ellipse, Row, Screen, ellipse_of

wp.set_module_options({"enable_backward": False})

SLACK = wp.constant(2e-3)  # px, against rounding: listing a pair in vain costs time, missing one would cost correctness


@wp.func
def depth_key(z: wp.float64, cuts: Cuts) -> wp.int32:
    """Bits of a float64 above those of the near plane: 31 of them hold 64 doublings and 25 binary digits of each."""
    steps = (wp.cast(z, wp.int64) - cuts.near_bits) >> wp.int64(27)
    return wp.int32(wp.min(steps, wp.int64(FAR - 1)))


@wp.func
def reaches_image(ellipse: Ellipse, screen: Screen) -> wp.bool:
    """Whether the exponent is within reach somewhere in the box of the image's pixel centres: exact.

    A convex quadratic over a box is smallest at its centre if that is inside, else on one of the sides that face it.
    """
    corner = wp.vec2(0.5, 0.5)
    low = corner - ellipse.whole - ellipse.rest
    high = wp.vec2(wp.float32(screen.size[0]), wp.float32(screen.size[1])) - corner - ellipse.whole - ellipse.rest
    near_x, near_y = wp.clamp(0.0, low[0], high[0]), wp.clamp(0.0, low[1], high[1])
    on_x = wp.clamp(-ellipse.B * near_x / (2.0 * ellipse.C), low[1], high[1])
    on_y = wp.clamp(-ellipse.B * near_y / (2.0 * ellipse.A), low[0], high[0])
    return wp.min(exponent(ellipse, near_x, on_x), exponent(ellipse, on_y, near_y)) <= ellipse.reach


@wp.func
def exponent(ellipse: Ellipse, dx: wp.float32, dy: wp.float32) -> wp.float32:
    return dx * (ellipse.A * dx + ellipse.B * dy) + ellipse.C * dy * dy


@wp.func
def row_of_tiles(y: wp.float32, screen: Screen) -> wp.int32:
    """The row of tiles whose pixel centres lie about y, within the image."""
    return wp.int32(wp.clamp(y - 0.5, 0.0, wp.float32(screen.size[1] - 1))) / TILE


@wp.func
def rows_of(ellipse: Ellipse, screen: Screen) -> tuple[wp.int32, wp.int32]:
    """First and last row of tiles that the ellipse may reach."""
    v = ellipse.whole[1] + ellipse.rest[1]
    return row_of_tiles(v - ellipse.half[1] - SLACK, screen), row_of_tiles(v + ellipse.half[1] + SLACK, screen)


@wp.func
def columns_of(ellipse: Ellipse, row: wp.int32, screen: Screen) -> tuple[wp.int32, wp.int32]:
    """Of a row of tiles, those that the ellipse reaches: [begin, end). Exact up to `SLACK`, always generous.

    Within the slab of the row's pixel centres the ellipse is widest at its rightmost point, or on the slab's side
    nearest to that.
    """
    first = wp.float32(row * TILE) + 0.5 - ellipse.whole[1] - ellipse.rest[1]
    last = first + wp.float32(TILE - 1)
    if not (first <= ellipse.half[1] + SLACK and last >= -ellipse.half[1] - SLACK):
        return wp.int32(0), wp.int32(0)
    low, high = wp.max(first, -ellipse.half[1]), wp.min(last, ellipse.half[1])
    rightmost = -ellipse.B / (2.0 * ellipse.C) * ellipse.half[0]
    right = chord(ellipse, wp.clamp(rightmost, low, high), 1.0)
    left = chord(ellipse, wp.clamp(-rightmost, low, high), -1.0)
    edge = wp.float32(TILE)
    limit = wp.float32(screen.tiles[0])
    begin = wp.clamp(wp.ceil((left - SLACK + 0.5) / edge) - 1.0, 0.0, limit)
    end = wp.clamp(wp.floor((right + SLACK - 0.5) / edge) + 1.0, 0.0, limit)
    return wp.int32(begin), wp.int32(end)


@wp.func
def chord(ellipse: Ellipse, dy: wp.float32, side: wp.float32) -> wp.float32:
    """Where the ellipse ends to the left (-1) or right (1) on the line dy px below its centre, px of the image."""
    t = dy / wp.max(ellipse.half[1], 1e-20)
    width = wp.sqrt(ellipse.reach / ellipse.A) * wp.sqrt(wp.max(1.0 - t * t, 0.0))
    return ellipse.whole[0] + ellipse.rest[0] - ellipse.B / (2.0 * ellipse.A) * dy + side * width


@wp.func
def count_tiles(ellipse: Ellipse, screen: Screen, masked: wp.bool, wanted: wp.array2d[wp.bool]) -> wp.int32:
    """How many tiles the ellipse may reach, of those that are wanted."""
    count = wp.int32(0)
    top, bottom = rows_of(ellipse, screen)
    for row in range(top, bottom + 1):
        begin, end = columns_of(ellipse, row, screen)
        if masked:
            for column in range(begin, end):
                if wanted[row, column]:
                    count += 1
        else:
            count += wp.max(end - begin, 0)
    return count


@wp.kernel
def list_pairs(
    order: wp.array[wp.int32],
    counts: wp.array[wp.int32],
    ends: wp.array[wp.int64],
    rows: wp.array[Row],
    screen: Screen,
    masked: wp.bool,
    wanted: wp.array2d[wp.bool],
    room: wp.int32,
    firsts: wp.array[wp.int32],
    tiles: wp.array[wp.int32],
    pairs: wp.array[wp.int32],
    splats: wp.array[wp.int32],
) -> None:
    """A thread per Gaussian, front to back: its tiles, from the top left on, at the places before `ends`.

    `counts` was found by the same function in another kernel, which a compiler may round otherwise. Should they differ,
    the places decide, and one that is left over holds a tile that does not exist. Places beyond `room` are not taken.
    """
    rank = wp.tid()
    i = order[rank]
    count = counts[i]
    if count == 0:
        return
    place_of_first = ends[rank] - wp.int64(count)
    if place_of_first >= wp.int64(room):
        return
    first = wp.int32(place_of_first)
    count = wp.min(count, room - first)
    firsts[i] = first
    ellipse = ellipse_of(rows[i])
    place = wp.int32(0)
    top, bottom = rows_of(ellipse, screen)
    for row in range(top, bottom + 1):
        begin, end = columns_of(ellipse, row, screen)
        for column in range(begin, end):
            if place < count and (not masked or wanted[row, column]):
                tiles[first + place] = row * screen.tiles[0] + column
                place += 1
    for left_over in range(place, count):
        tiles[first + left_over] = screen.tiles[0] * screen.tiles[1]
    for nth in range(count):
        pairs[first + nth] = first + nth
        splats[first + nth] = i


@wp.kernel
def find_tiles(
    tiles: wp.array[wp.int32],
    pairs: wp.array[wp.int32],
    splats: wp.array[wp.int32],
    totals: wp.array[wp.int64],
    nth: wp.int32,
    room: wp.int32,
    listed: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    ends: wp.array[wp.int32],
) -> None:
    """A thread per pair, sorted by tile: where each tile's list begins and ends, and the Gaussians in it.

    `totals` of the `nth` screen: how many of the places hold a pair.
    """
    at = wp.tid()
    count = wp.int32(wp.min(totals[nth], wp.int64(room)))
    if at >= count:
        return
    tile = tiles[at]
    listed[at] = splats[pairs[at]]
    if at == 0 or tiles[at - 1] != tile:
        starts[tile] = at
    if at == count - 1 or tiles[at + 1] != tile:
        ends[tile] = at + 1
