"""One writer per folder: a job holds `run.lock` while it works there.

The system frees the lock of a process that has died, so a killed run does not block the next; the empty file stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from clear_strategies.errors import DataError

NAME: Final = "run.lock"


class HeldError(DataError):
    """Another running process holds the folder."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Hold the lock of `folder`, which is created if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / NAME, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise HeldError(
            folder / NAME, "lock", "another run is at work in this folder", "wait for it, or take another folder"
        ) from error
    try:
        yield
    finally:
        lock.release()
