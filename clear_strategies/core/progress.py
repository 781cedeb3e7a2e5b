"""Log lines about the progress of long work."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from typing import Final, TypeVar

T = TypeVar("T")

_log = logging.getLogger(__name__)

FIRST: Final = 2.0  # seconds until a line: shorter work needs none
EVERY: Final = 10.0  # seconds between two lines


class Progress:
    """Logs how much is done and how long the rest takes: first after `first` seconds, then at most every `EVERY` seconds.

    Args:
        what: the work. unit: what is counted, in the plural.
    """

    def __init__(self, what: str, unit: str, total: int, first: float = FIRST) -> None:
        self.what, self.unit, self.total = what, unit, total
        self._began = time.monotonic()
        self._due, self._done = self._began + first, 0

    def __call__(self, done: int) -> None:
        """Log that `done` of `total` are done, if a line is due and `done` has grown since the last one."""
        now = time.monotonic()
        if now >= self._due and self._done < done < self.total:
            left = duration((now - self._began) * (self.total - done) / done)
            _log.info("%s: %d of %d %s, about %s left", self.what, done, self.total, self.unit, left)
            self._due, self._done = now + EVERY, done


def told(items: Iterable[T], what: str, unit: str, total: int, first: float = FIRST) -> Iterator[T]:
    """Yield the items, and log as `Progress` does how many have been used."""
    progress = Progress(what, unit, total, first)
    for done, item in enumerate(items, 1):
        yield item
        progress(done)


def duration(seconds: float) -> str:
    """Format a duration: "50 s", "7 min 12 s"."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
