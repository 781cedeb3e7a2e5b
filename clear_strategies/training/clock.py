"""The clock of training time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final

WALL: Final = "seconds"
PROCESSOR: Final = "processor_seconds"
"""Columns of the history. On a busy machine CPU seconds are the better measure."""


class Clock:
    """Seconds of training by the wall, and of this process on all processors. A pause does not count.

    Args:
        before: the last row of the history of a run that goes on; its seconds count.
    """

    def __init__(self, before: Mapping[str, float]) -> None:
        self._began = {name: now - before.get(name, 0.0) for name, now in _now().items()}

    def read(self) -> dict[str, float]:
        """The seconds until now, by the history's columns."""
        return {name: now - self._began[name] for name, now in _now().items()}

    @contextmanager
    def paused(self) -> Iterator[None]:
        """A context whose time does not count."""
        before = self.read()
        try:
            yield
        finally:
            self._began = Clock(before)._began


def _now() -> dict[str, float]:
    return {WALL: time.perf_counter(), PROCESSOR: time.process_time()}
