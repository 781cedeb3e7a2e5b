"""The kernel of L1, and what all losses share: the sign function, and the sum over blocks.

Every block writes its part of the loss to `parts`, in float64, and one block then adds them up: sums have a fixed order.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def sign(x: wp.float32) -> wp.float32:
    """-1, 0 or 1; 0 for NaN."""
    return wp.where(x > 0.0, 1.0, 0.0) - wp.where(x < 0.0, 1.0, 0.0)


@wp.kernel
def absolute(
    x: wp.array2d[wp.float32],
    y: wp.array2d[wp.float32],
    weight: wp.float64,
    step: wp.float32,
    out: wp.array2d[wp.float32],
    parts: wp.array[wp.float64],
) -> None:
    """L1, with a block of threads per row: writes step · sign(x - y), and the part weight · Σ |x - y|."""
    row, lane = wp.tid()
    share = wp.float64(0.0)
    for column in range(lane, x.shape[1], wp.block_dim()):
        difference = x[row, column] - y[row, column]
        out[row, column] = step * sign(difference)
        share += wp.float64(wp.abs(difference))
    wp.tile_store(parts, wp.tile_sum(wp.tile(weight * share)), offset=(row,))


@wp.kernel
def total(parts: wp.array[wp.float64], value: wp.array[wp.float32]) -> None:
    """Σ parts in float32, by one block."""
    _, lane = wp.tid()
    share = wp.float64(0.0)
    for part in range(lane, parts.shape[0], wp.block_dim()):
        share += parts[part]
    wp.tile_store(value, wp.tile_astype(wp.tile_sum(wp.tile(share)), wp.float32))
