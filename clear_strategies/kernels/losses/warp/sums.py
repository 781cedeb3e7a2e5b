"""The kernel of L1, and what all losses share: the sign function, and the sum over blocks.

Every block writes its part of the loss to `parts`, in float64, and one block then adds them up: sums have a fixed order.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def sign(x: wp.float32) -> wp.float32:
    """-1, 0 or 1; 0 for NaN."""
    return wp.where(x > 0.0, 1.0, 0.0) - wp.where(x < 0.0, 1.0, 0.0)


@cache
def absolute(lanes: int) -> Any:
    """The kernel of L1, with `lanes` threads per row: writes step · sign(x - y), and the part weight · Σ |x - y|."""

    @wp.kernel(module="unique", enable_backward=False)
    def absolute(
        x: wp.array2d[wp.float32],
        y: wp.array2d[wp.float32],
        weight: wp.float64,
        step: wp.float32,
        out: wp.array2d[wp.float32],
        parts: wp.array[wp.float64],
    ) -> None:
        row, lane = wp.tid()
        share = wp.float64(0.0)
        for column in range(lane, x.shape[1], lanes):
            difference = x[row, column] - y[row, column]
            out[row, column] = step * sign(difference)
            share += wp.float64(wp.abs(difference))
        wp.tile_store(parts, wp.tile_sum(wp.tile(weight * share)), offset=(row,))

    return absolute


@cache
def total(lanes: int) -> Any:
    """The kernel that writes Σ parts in float32, with one block of `lanes` threads."""

    @wp.kernel(module="unique", enable_backward=False)
    def total(parts: wp.array[wp.float64], value: wp.array[wp.float32]) -> None:
        _, lane = wp.tid()
        share = wp.float64(0.0)
        for part in range(lane, parts.shape[0], lanes):
            share += parts[part]
        wp.tile_store(value, wp.tile_astype(wp.tile_sum(wp.tile(share)), wp.float32))

    return total
