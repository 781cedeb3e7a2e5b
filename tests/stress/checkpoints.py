"""Faults at every file operation of a save, and damage to every part of a checkpoint."""

from __future__ import annotations

import errno
import os
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

from clear_strategies import files
from clear_strategies.errors import DataError
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import Checkpoint
from tests.stress.rows import Row, Worst


class Killed(BaseException):
    """The process is gone: no operation after it happens either."""


FAULTS: dict[str, Callable[[], BaseException]] = {
    "kill": Killed,
    "ENOSPC": lambda: OSError(errno.ENOSPC, "No space left on device"),
    "EIO": lambda: OSError(errno.EIO, "Input/output error"),
    "EACCES": lambda: PermissionError(errno.EACCES, "Permission denied"),
}


@contextmanager
def fault(at: int, make: Callable[[], BaseException]) -> Iterator[list[str]]:
    """Let the `at`-th operation on files fail; after a kill all later ones do nothing. Yields the operations by name."""
    seen: list[str] = []
    dead = False

    def wrapped(name: str, real: Callable):
        def call(*arguments, **options):
            nonlocal dead
            if dead:
                raise Killed
            seen.append(name)
            if len(seen) == at:
                error = make()
                dead = isinstance(error, Killed)
                raise error
            return real(*arguments, **options)

        return call

    def remove_tree(path, ignore_errors=False, **_):
        """As shutil.rmtree, in operations that each may fail."""
        try:
            for entry in sorted(Path(path).iterdir()):
                entry.unlink()
            Path(path).rmdir()
        except OSError:
            if not ignore_errors:
                raise

    patched = [(Path, name) for name in ("mkdir", "rename", "replace", "unlink", "rmdir")] + [(os, "fsync")]
    before = [(owner, name, getattr(owner, name)) for owner, name in patched] + [(shutil, "rmtree", shutil.rmtree)]
    for owner, name, real in before[:-1]:
        setattr(owner, name, wrapped(name, real))
    shutil.rmtree = remove_tree
    write = checkpoint._write_durably

    def half(path: Path, data: bytes) -> None:
        """A write that fails leaves half of the file."""
        try:
            wrapped("write", write)(path, data)
        except BaseException:
            path.write_bytes(data[: len(data) // 2])
            raise

    checkpoint._write_durably = half
    try:
        yield seen
    finally:
        checkpoint._write_durably = write
        for owner, name, real in before:
            setattr(owner, name, real)


def small(t: int, value: float) -> Checkpoint:
    facts = {"optimizer_steps": float(t), "degree": 1.0}
    tensors = {"field/means": torch.full((5, 3), value)}
    work = {"render LR": {"runs": t, "seconds": 1.5, "skipped": {"why": 2}}}
    return Checkpoint(t, tensors, {"fit.seed": 1}, facts, [{"t": 1.0, "loss": 0.25}], work)


def faults(folder: Path) -> Row:
    """Every operation of a save fails in every way; afterwards a checkpoint loads, and the next start leaves nothing."""
    lost = Worst()
    for keep, again in ((1, False), (1, True), (3, False), (3, True)):
        for kind, make in FAULTS.items():
            for at in range(1, 200):
                here = folder / f"{keep}{again}{kind}{at}"
                checkpoint.save(here, small(100, 1.0), keep=keep)
                with fault(at, make) as seen, suppress(OSError, Killed):
                    checkpoint.save(here, small(100 if again else 200, 2.0), keep=keep)
                lost.add(
                    float(not _whole(here)),
                    f"{kind} at {seen[-1] if seen else 'nothing'} {at}, keep={keep}, again={again}",
                )
                shutil.rmtree(here)
                if len(seen) < at:  # the save came to its end
                    break
    return lost.row("saves with a fault: checkpoints lost, or rests after the next start", "all", 0)


def _whole(folder: Path) -> bool:
    files.sweep(folder)
    try:
        found = checkpoint.load(folder)
    except DataError:
        return False
    names = {path.name for path in folder.iterdir()}
    rests = {name for name in names if not name.startswith("step_")}
    value = float(found.tensors["field/means"][0, 0])
    return not rests and value in (1.0, 2.0) and bool((found.tensors["field/means"] == value).all())


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
