"""The kernels of the Haar loss: the details of every block of 2 x 2 pixels, and their gradient.

A level turns a block (a b; c d) of x - y into its low part (a+b+c+d)/2, the input of the next level, and three details:
(a-b+c-d)/2, (a+b-c-d)/2, (a-b-c+d)/2. An odd last row or column is repeated; the repeated pixel receives both gradients.
"""

from __future__ import annotations

import warp as wp

from clear_strategies.kernels.losses.warp.sums import sign

wp.set_module_options({"enable_backward": False})


@wp.func
def pixel(x: wp.array2d[wp.vec3], y: wp.array2d[wp.vec3], row: wp.int32, column: wp.int32) -> wp.vec3:
    """A pixel of x - y at the first level, and of the low part x at the others, without a y; beyond the edge the last one is
    repeated.
    """
    i, j = wp.min(row, x.shape[0] - 1), wp.min(column, x.shape[1] - 1)
    if y.shape[0] > 0:
        return x[i, j] - y[i, j]
    return x[i, j]


@wp.func
def signs(v: wp.vec3) -> wp.vec3:
    return wp.vec3(sign(v[0]), sign(v[1]), sign(v[2]))


@wp.kernel
def low_part(x: wp.array2d[wp.vec3], y: wp.array2d[wp.vec3], low: wp.array2d[wp.vec3]) -> None:
    """One thread per block."""
    i, j = wp.tid()
    a, b = pixel(x, y, 2 * i, 2 * j), pixel(x, y, 2 * i, 2 * j + 1)
    c, d = pixel(x, y, 2 * i + 1, 2 * j), pixel(x, y, 2 * i + 1, 2 * j + 1)
    low[i, j] = 0.5 * (a + b + c + d)


@wp.kernel
def details(
    x: wp.array2d[wp.vec3],
    y: wp.array2d[wp.vec3],
    above: wp.array2d[wp.vec3],
    weight: wp.float64,
    out: wp.array2d[wp.vec3],
    parts: wp.array[wp.float64],
) -> None:
    """Weight · Σ |details| + <above, low part>, a block of threads per row of blocks: writes the gradient, and the row's part of
    the first sum. The last level has no `above`.
    """
    i, lane = wp.tid()
    step = 0.5 * wp.float32(weight)
    share = wp.float64(0.0)
    for j in range(lane, (x.shape[1] + 1) / 2, wp.block_dim()):
        a, b = pixel(x, y, 2 * i, 2 * j), pixel(x, y, 2 * i, 2 * j + 1)
        c, d = pixel(x, y, 2 * i + 1, 2 * j), pixel(x, y, 2 * i + 1, 2 * j + 1)
        horizontal, vertical, diagonal = a - b + c - d, a + b - c - d, a - b - c + d  # doubled
        share += wp.float64(wp.norm_l1(horizontal) + wp.norm_l1(vertical) + wp.norm_l1(diagonal))
        h, v, hv = step * signs(horizontal), step * signs(vertical), step * signs(diagonal)
        low = wp.vec3(0.0, 0.0, 0.0)
        if above.shape[0] > 0:
            low = 0.5 * above[i, j]
        a, b, c, d = low + h + v + hv, low - h + v - hv, low + h - v - hv, low - h - v + hv
        has_right, has_lower = 2 * j + 1 < x.shape[1], 2 * i + 1 < x.shape[0]
        if not has_right:
            a, c = a + b, c + d
        if not has_lower:
            a, b = a + c, b + d
        out[2 * i, 2 * j] = a
        if has_right:
            out[2 * i, 2 * j + 1] = b
        if has_lower:
            out[2 * i + 1, 2 * j] = c
        if has_right and has_lower:
            out[2 * i + 1, 2 * j + 1] = d
    wp.tile_store(parts, wp.tile_sum(wp.tile(wp.float64(0.5) * weight * share)), offset=(i,))
