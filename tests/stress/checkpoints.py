"""Damage to every part of a checkpoint: a flipped bit or a cut file is never read as a sound one."""

from __future__ import annotations

import random
from pathlib import Path

from clear_strategies.errors import DataError
from clear_strategies.training import checkpoint
from tests.stress.faults import small
from tests.stress.rows import Row, Worst


def integrity(folder: Path, flips: int) -> Row:
    """Single bits flipped, and files cut short: each is a DataError."""
    path = checkpoint.save(folder, small(100, 1.0))
    rng = random.Random(0)  # noqa: S311 - no secret
    accepted = Worst()
    for file in sorted(path.iterdir()):
        good = file.read_bytes()
        for _ in range(flips):
            data = bytearray(good)
            bit = rng.randrange(8 * len(data))
            data[bit // 8] ^= 1 << bit % 8
            accepted.add(_accepts(path, file, bytes(data)), f"bit {bit} of {file.name}")
        for length in range(0, len(good), max(1, len(good) // 40)):
            accepted.add(_accepts(path, file, good[:length]), f"{file.name} cut to {length} bytes")
        file.write_bytes(good)
    return accepted.row("checkpoints with a flipped bit or cut short: accepted, or another error", "all", 0)


def _accepts(path: Path, file: Path, data: bytes) -> float:
    file.write_bytes(data)
    try:
        checkpoint.load(path)
    except DataError:
        return 0.0
    except Exception:
        return 1.0
    return 1.0
