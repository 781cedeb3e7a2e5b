"""The kernels of SSIM (11 x 11 Gaussian window, σ = 1.5, zero padding): its maps, and the gradient.

With the difference d = y - x of the images, SSIM factorises:

    SSIM = (1 - u)(1 - n),   u = μd² / B1,  1 - u = A1 / B1,  A1 = 2 μx μy + C1,  B1 = A1 + μd²,
                             n = σd² / B2,  1 - n = A2 / B2,  A2 = 2 σxy + C2,    B2 = A2 + σd².

With a window w around q, the gradient at a pixel p is

    ∂Σ SSIM / ∂x_p = Σ_q w(p-q) [a(q) + b(q) (y_p - μy(q)) + c(q) (d_p - μd(q))],
    a = 2 (1-n) ((1-u) μd + u μy) / B1,   b = 2 (1-u) n / B2,   c = 2 (1-u) (1-n) / B2.

Windows are separable: columns first, then rows. Every sum is taken about a value inside its window, because flat regions
would otherwise lose their variance. `kernels/src/ssim.hpp` does the same, and says why in this form.

Channels are interleaved: a row is W · 3 numbers, and a neighbour is three numbers away. A block of threads has `ROWS` rows of
`WIDTH` numbers, including those that its windows reach on either side, and a thread per column: the thread sums down the
column with the block's rows in registers, writes the sums to shared memory, and continues along the rows. On a CPU, where
Warp's blocks have one thread, this thread processes all columns.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import warp as wp

from clear_strategies.kernels.losses.reference import gaussian_window
from clear_strategies.kernels.losses.warp.sums import sign

wp.set_module_options({"enable_backward": False})

REACH: Final = 5
TAPS: Final = 2 * REACH + 1
ROWS: Final = 6  # SPAN is then 16, the longest loop that Warp unrolls
SPAN: Final = ROWS + TAPS - 1
WIDTH: Final = 256
HALO: Final = 3 * REACH
STRIDE: Final = WIDTH - 2 * HALO
"""Numbers of a row that a block computes; the rest of `WIDTH` is what their windows reach."""
MAPS: Final = 5
"""The maps are μy, μd, a, b and c."""

Rows: Final[Any] = wp.types.vector(length=ROWS, dtype=wp.float32)
WINDOW: Final = wp.constant(wp.types.vector(length=TAPS, dtype=wp.float32)(*gaussian_window()))
SHARES: Final = wp.constant(
    wp.types.matrix(shape=(SPAN, ROWS), dtype=wp.float32)(
        *(gaussian_window()[k - r] if 0 <= k - r < TAPS else 0.0 for k in range(SPAN) for r in range(ROWS))
    )
)
"""The weights of the k-th row that a block reads, in the windows around each of the block's rows."""
C1: Final = wp.constant(0.01**2)
C2: Final = wp.constant(0.03**2)


@wp.func
def pair_at(x: wp.array2d[wp.float32], y: wp.array2d[wp.float32], row: wp.int32, column: wp.int32) -> wp.vec2:
    """Image y and the difference d, 0 beyond the image. Always loads, because unconditional loads overlap."""
    i, j = wp.clamp(row, 0, x.shape[0] - 1), wp.clamp(column, 0, x.shape[1] - 1)
    pair = wp.vec2(y[i, j], y[i, j] - x[i, j])
    return wp.where(i == row and j == column, pair, wp.vec2(0.0, 0.0))


@wp.func
def map_at(maps: wp.array3d[wp.float32], nth: wp.int32, row: wp.int32, column: wp.int32) -> wp.float32:
    """A value of a map, 0 beyond the image."""
    i, j = wp.clamp(row, 0, maps.shape[1] - 1), wp.clamp(column, 0, maps.shape[2] - 1)
    return wp.where(i == row and j == column, maps[nth, i, j], 0.0)


@wp.func
def dissimilarity(
    about: wp.vec4, y0: wp.float32, d0: wp.float32, row: wp.int32, column: wp.int32, maps: wp.array3d[wp.float32]
) -> wp.float32:
    """Compute 1 - SSIM of a pixel, and store its maps; `about` holds the means of y, d, xy and d² about y0 and d0."""
    my, md = about[0] + y0, about[1] + d0
    cxy = about[2] - (about[0] - about[1]) * about[0]
    vd = about[3] - about[1] * about[1]
    A1 = 2.0 * (my - md) * my + C1
    A2 = 2.0 * cxy + C2
    over_B1, over_B2 = 1.0 / (A1 + md * md), 1.0 / (A2 + vd)
    u, not_u = md * md * over_B1, A1 * over_B1
    n, not_n = vd * over_B2, A2 * over_B2
    maps[0, row, column] = my
    maps[1, row, column] = md
    maps[2, row, column] = 2.0 * not_n * (not_u * md + u * my) * over_B1
    maps[3, row, column] = 2.0 * not_u * over_B2 * n
    maps[4, row, column] = 2.0 * not_u * over_B2 * not_n
    return u + n - u * n


@wp.func
def blocks_across(width: wp.int32) -> wp.int32:
    return (width + STRIDE - 1) / STRIDE


@cache
def similarity(lanes: int) -> Any:
    """The kernel that computes the maps, with `lanes` threads per block; a block's part is weight · Σ (1 - SSIM)."""
    turns = WIDTH // lanes

    @wp.kernel(module="unique", enable_backward=False)
    def similarity(
        x: wp.array2d[wp.float32],
        y: wp.array2d[wp.float32],
        weight: wp.float64,
        maps: wp.array3d[wp.float32],
        parts: wp.array[wp.float64],
    ) -> None:
        group, across, lane = wp.tid()
        height, width = x.shape[0], x.shape[1]
        top, left = group * ROWS, across * STRIDE - HALO
        mean_y = wp.tile_empty(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
        mean_d = wp.tile_empty(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
        cov_xy = wp.tile_empty(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
        var_d = wp.tile_empty(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")

        for turn in range(turns):
            at = turn * lanes
            column = left + at + lane
            origin = pair_at(x, y, wp.min(top + ROWS / 2, height - 1), column)
            MY, MD, CXY, VD = Rows(), Rows(), Rows(), Rows()
            for k in range(SPAN):
                near, w = pair_at(x, y, top - REACH + k, column) - origin, SHARES[k]
                MY += w * near[0]
                MD += w * near[1]
                CXY += w * ((near[0] - near[1]) * near[0])
                VD += w * (near[1] * near[1])
            wp.tile_assign(mean_y, wp.tile(MY + Rows(origin[0])), offset=(0, at))
            wp.tile_assign(mean_d, wp.tile(MD + Rows(origin[1])), offset=(0, at))
            wp.tile_assign(cov_xy, wp.tile(CXY - wp.cw_mul(MY - MD, MY)), offset=(0, at))
            wp.tile_assign(var_d, wp.tile(VD - wp.cw_mul(MD, MD)), offset=(0, at))

        total = wp.float64(0.0)
        for at in range(HALO + lane, wp.min(WIDTH - HALO, width - left), lanes):
            for r in range(wp.min(ROWS, height - top)):
                y0, d0 = mean_y[r, at], mean_d[r, at]
                means = wp.vec4()  # about y0 and d0
                for k in range(TAPS):
                    neighbour = at + (k - REACH) * 3
                    dy, dd = mean_y[r, neighbour] - y0, mean_d[r, neighbour] - d0
                    cxy, vd = cov_xy[r, neighbour] + (dy - dd) * dy, var_d[r, neighbour] + dd * dd
                    means += WINDOW[k] * wp.vec4(dy, dd, cxy, vd)
                total += wp.float64(dissimilarity(means, y0, d0, top + r, left + at, maps))
        wp.tile_store(parts, wp.tile_sum(wp.tile(weight * total)), offset=(group * blocks_across(width) + across,))

    return similarity


@cache
def gradient(lanes: int) -> Any:
    """The kernel of the gradient of SSIM and L1, with `lanes` threads per block; a block adds L1 to its part."""
    turns = WIDTH // lanes

    @wp.kernel(module="unique", enable_backward=False)
    def gradient(
        x: wp.array2d[wp.float32],
        y: wp.array2d[wp.float32],
        maps: wp.array3d[wp.float32],
        l1_weight: wp.float64,
        l1_step: wp.float32,
        ssim_step: wp.float32,
        out: wp.array2d[wp.float32],
        parts: wp.array[wp.float64],
    ) -> None:
        group, across, lane = wp.tid()
        height, width = x.shape[0], x.shape[1]
        top, left = group * ROWS, across * STRIDE - HALO
        sum_a = wp.tile_empty(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
        sum_b = wp.tile_empty(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
        sum_c = wp.tile_empty(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
        origin_y = wp.tile_empty(shape=(WIDTH,), dtype=wp.float32, storage="shared")
        origin_d = wp.tile_empty(shape=(WIDTH,), dtype=wp.float32, storage="shared")

        for turn in range(turns):
            at = turn * lanes
            column, middle = left + at + lane, wp.min(top + ROWS / 2, height - 1)
            y0, d0 = map_at(maps, 0, middle, column), map_at(maps, 1, middle, column)
            A, B, C = Rows(), Rows(), Rows()
            for k in range(SPAN):
                row, w = top - REACH + k, SHARES[k]
                my, md = map_at(maps, 0, row, column), map_at(maps, 1, row, column)
                b, c = map_at(maps, 3, row, column), map_at(maps, 4, row, column)
                A += w * (map_at(maps, 2, row, column) + b * (y0 - my) + c * (d0 - md))
                B += w * b
                C += w * c
            wp.tile_assign(sum_a, wp.tile(A), offset=(0, at))
            wp.tile_assign(sum_b, wp.tile(B), offset=(0, at))
            wp.tile_assign(sum_c, wp.tile(C), offset=(0, at))
            wp.tile_assign(origin_y, wp.tile(y0), offset=(at,))
            wp.tile_assign(origin_d, wp.tile(d0), offset=(at,))

        total = wp.float64(0.0)
        for at in range(HALO + lane, wp.min(WIDTH - HALO, width - left), lanes):
            for r in range(wp.min(ROWS, height - top)):
                pair = pair_at(x, y, top + r, left + at)
                g = wp.float32(0.0)
                for k in range(TAPS):
                    neighbour = at + (k - REACH) * 3
                    about = pair - wp.vec2(origin_y[neighbour], origin_d[neighbour])
                    g += WINDOW[k] * (
                        sum_a[r, neighbour] + sum_b[r, neighbour] * about[0] + sum_c[r, neighbour] * about[1]
                    )
                out[top + r, left + at] = ssim_step * g - l1_step * sign(pair[1])
                total += wp.float64(wp.abs(pair[1]))
        total *= l1_weight
        part = group * blocks_across(width) + across
        if lane == 0:
            total += parts[part]  # written by `similarity`
        wp.tile_store(parts, wp.tile_sum(wp.tile(total)), offset=(part,))

    return gradient
