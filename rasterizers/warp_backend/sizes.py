"""The sizes of tiles, segments and lists."""

from __future__ import annotations

from typing import Final

TILE: Final = 8
"""Edge of the tiles that Gaussians are listed for, px."""
SEGMENT: Final = 64
"""The most pairs that one thread, or one block of threads, goes through in turn: some tiles' lists and some Gaussians' are
a hundred times as long as the others'."""
PAIR_BYTES: Final = 40
"""Of a pair's tile and place, twice for the sort, the Gaussian, before and after it, and a share of the marks."""
SUMS_BYTES: Final = 36
"""Of a pair's nine sums for one cotangent."""


def padded(count: int) -> int:
    """The next power of two, so that torch's allocator reuses memory from the last image."""
    return 1 << max(0, count - 1).bit_length()


def mebibytes(pairs: int) -> int:
    """Memory of the pairs' lists and of their sums for one cotangent."""
    return padded(pairs) * (PAIR_BYTES + SUMS_BYTES) >> 20
