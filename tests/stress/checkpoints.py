"""Damage to every part of a checkpoint: a flipped bit or a cut file is never read as a sound one."""

from __future__ import annotations

import random
from pathlib import Path

from clear_strategies.errors import DataError
from clear_strategies.training import checkpoint
from tests.stress.faults import small
from tests.stress.rows import Row, Worst


def integrity(folder: Path, most: int) -> Row:
    """Single bits flipped, and files cut short: each is a DataError.

    Args:
        most: of the bits, chosen at random; all of them where there are fewer.
    """
    path = checkpoint.save(folder, small(100, 1.0))
    good, accepted = path.read_bytes(), Worst()
    bits = range(8 * len(good))
    for bit in bits if len(bits) <= most else random.Random(0).sample(bits, most):  # noqa: S311 - no secret
        data = bytearray(good)
        data[bit // 8] ^= 1 << bit % 8
        accepted.add(_accepts(path, bytes(data)), f"bit {bit}")
    for length in range(0, len(good), max(1, 40 * len(good) // most)):
        accepted.add(_accepts(path, good[:length]), f"cut to {length} bytes")
    return accepted.row("checkpoints with a flipped bit or cut short: accepted, or another error", "all", 0)


def _accepts(path: Path, data: bytes) -> float:
    path.write_bytes(data)
    try:
        checkpoint.load(path)
    except DataError:
        return 0.0
    except Exception:
        return 1.0
    return 1.0
