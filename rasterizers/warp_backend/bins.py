"""Bin: lists the Gaussians that may touch each tile of 8 x 8 pixels, front to back.

Gaussians are sorted by depth once for all grids of a pose. Pairs are listed in this order and then sorted by tile with a
stable sort. A Gaussian's pairs are listed contiguously in the order of its tiles; the VJP stores each pair's sums at that
place, so that a Gaussian's sums have a fixed order.
"""

from __future__ import annotations

import warp as wp

from rasterizers.warp_backend.sizes import TILE
from rasterizers.warp_backend.types import FAR, Cuts, Ellipse, Grid

wp.set_module_options({"enable_backward": False})

SLACK = 2e-3  # px, margin for rounding: an unnecessary pair only costs time


@wp.func
def depth_key(z: wp.float64, cuts: Cuts) -> wp.int32:
    """The depth as 31 bits above the near plane: 64 powers of two with 25 bits each."""
    steps = (wp.cast(z, wp.int64) - cuts.near_bits) >> wp.int64(27)
    return wp.int32(wp.min(steps, wp.int64(FAR - 1)))


@wp.func
def reaches_image(ellipse: Ellipse, grid: Grid) -> wp.bool:
    """Whether the smallest exponent over the box of the image's pixel centres is within reach; exact.

    A convex quadratic has its minimum over a box at its centre if that is inside, else on a side that faces the centre.
    """
    corner = wp.vec2(0.5, 0.5)
    low = corner - ellipse.whole - ellipse.rest
    high = wp.vec2(wp.float32(grid.size[0]), wp.float32(grid.size[1])) - corner - ellipse.whole - ellipse.rest
    near_x, near_y = wp.clamp(0.0, low[0], high[0]), wp.clamp(0.0, low[1], high[1])
    on_x = wp.clamp(tallest(ellipse) * near_x, low[1], high[1])
    on_y = wp.clamp(-ellipse.S * near_y, low[0], high[0])
    at_x = exponent(ellipse.A, ellipse.D, near_x + ellipse.S * on_x, on_x)
    at_y = exponent(ellipse.A, ellipse.D, on_y + ellipse.S * near_y, near_y)
    return wp.min(at_x, at_y) <= ellipse.reach


@wp.func
def exponent(A: wp.float32, D: wp.float32, u: wp.float32, dy: wp.float32) -> wp.float32:
    return A * u * u + D * dy * dy


@wp.func
def precision_y(ellipse: Ellipse) -> wp.float32:
    """The exponent's coefficient of dy²."""
    return ellipse.A * ellipse.S * ellipse.S + ellipse.D


@wp.func
def tallest(ellipse: Ellipse) -> wp.float32:
    """The dy per dx of the smallest exponent at this dx."""
    return -ellipse.A * ellipse.S / precision_y(ellipse)


@wp.func
def row_of_tiles(y: wp.float32, grid: Grid) -> wp.int32:
    """The row of tiles that contains y, clamped to the image."""
    return wp.int32(wp.clamp(y - 0.5, 0.0, wp.float32(grid.size[1] - 1))) / TILE


@wp.func
def rows_of(ellipse: Ellipse, grid: Grid) -> tuple[wp.int32, wp.int32]:
    """First and last row of tiles that the ellipse may reach."""
    v = ellipse.whole[1] + ellipse.rest[1]
    return row_of_tiles(v - ellipse.half[1] - SLACK, grid), row_of_tiles(v + ellipse.half[1] + SLACK, grid)


@wp.func
def columns_of(ellipse: Ellipse, row: wp.int32, grid: Grid) -> tuple[wp.int32, wp.int32]:
    """The tiles [begin, end) of a row that the ellipse reaches, exact up to the margin `SLACK`.

    Within the row's pixel centres the ellipse is widest at its rightmost point, or at the y nearest to that point.
    """
    first = wp.float32(row * TILE) + 0.5 - ellipse.whole[1] - ellipse.rest[1]
    last = first + wp.float32(TILE - 1)
    if not (first <= ellipse.half[1] + SLACK and last >= -ellipse.half[1] - SLACK):
        return wp.int32(0), wp.int32(0)
    low, high = wp.max(first, -ellipse.half[1]), wp.min(last, ellipse.half[1])
    rightmost = tallest(ellipse) * ellipse.half[0]
    right = chord(ellipse, wp.clamp(rightmost, low, high), 1.0)
    left = chord(ellipse, wp.clamp(-rightmost, low, high), -1.0)
    edge = wp.float32(TILE)
    limit = wp.float32(grid.tiles[0])
    begin = wp.clamp(wp.ceil((left - SLACK + 0.5) / edge) - 1.0, 0.0, limit)
    end = wp.clamp(wp.floor((right + SLACK - 0.5) / edge) + 1.0, 0.0, limit)
    return wp.int32(begin), wp.int32(end)


@wp.func
def chord(ellipse: Ellipse, dy: wp.float32, side: wp.float32) -> wp.float32:
    """The x where the ellipse ends to the left (-1) or right (1), dy px below its centre."""
    t = dy / wp.max(ellipse.half[1], 1e-20)
    width = wp.sqrt(ellipse.reach / ellipse.A) * wp.sqrt(wp.max(1.0 - t * t, 0.0))
    return ellipse.whole[0] + ellipse.rest[0] - ellipse.S * dy + side * width


@wp.func
def count_tiles(ellipse: Ellipse, grid: Grid) -> wp.int32:
    """The number of tiles that the ellipse may reach."""
    count = wp.int32(0)
    top, bottom = rows_of(ellipse, grid)
    for row in range(top, bottom + 1):
        begin, end = columns_of(ellipse, row, grid)
        count += wp.max(end - begin, 0)
    return count


@wp.func
def nth_tile(ellipse: Ellipse, nth: wp.int32, grid: Grid) -> wp.int32:
    """The n-th tile that the ellipse may reach, from the top left on; the tile that does not exist if it reaches fewer."""
    left = nth
    top, bottom = rows_of(ellipse, grid)
    for row in range(top, bottom + 1):
        begin, end = columns_of(ellipse, row, grid)
        if left < end - begin:
            return row * grid.tiles[0] + begin + left
        left -= wp.max(end - begin, 0)
    return grid.tiles[0] * grid.tiles[1]


@wp.kernel
def list_pairs(
    order: wp.array[wp.int32],
    ends: wp.array[wp.int64],
    ellipses: wp.array[Ellipse],
    grids: wp.array[Grid],
    firsts: wp.array[wp.int32],
    tiles: wp.array[wp.int32],
    places: wp.array[wp.int32],
    splats: wp.array[wp.int32],
) -> None:
    """One thread per place: its Gaussian, front to back, and which of the Gaussian's tiles it holds.

    The Gaussian at `order[rank]` has the places from `ends[rank - 1]` to `ends[rank]`, as many as another kernel counted, where
    the compiler may round differently; if the tiles differ, the number of places holds. Places without a tile, and those beyond
    the last Gaussian's, get the tile that does not exist.
    """
    place, grid = wp.tid(), grids[0]
    tiles[place] = grid.tiles[0] * grid.tiles[1]
    places[place] = place
    if wp.int64(place) >= ends[ends.shape[0] - 1]:
        return
    rank = wp.lower_bound(ends, wp.int64(place) + wp.int64(1))
    i, nth = order[rank], place
    if rank > 0:
        nth -= wp.int32(ends[rank - 1])
    if nth == 0:
        firsts[i] = place
    tiles[place] = nth_tile(ellipses[i], nth, grid)
    splats[place] = i


@wp.kernel
def find_tiles(
    tiles: wp.array[wp.int32],
    places: wp.array[wp.int32],
    splats: wp.array[wp.int32],
    total: wp.array[wp.int64],
    capacity: wp.int32,
    listed: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    ends: wp.array[wp.int32],
) -> None:
    """One thread per pair, sorted by tile: where each tile's list starts and ends, and its Gaussians.

    `total` is the number of pairs.
    """
    at = wp.tid()
    count = wp.int32(wp.min(total[0], wp.int64(capacity)))
    if at >= count:
        return
    tile = tiles[at]
    listed[at] = splats[places[at]]
    if at == 0 or tiles[at - 1] != tile:
        starts[tile] = at
    if at == count - 1 or tiles[at + 1] != tile:
        ends[tile] = at + 1
