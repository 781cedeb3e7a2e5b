"""How far long work is, said now and then: a user who waits sees that something happens."""

from __future__ import annotations

import logging
import time
from typing import Final

_log = logging.getLogger(__name__)

EVERY: Final = 10.0  # seconds between two lines


class Progress:
    """Counts what is done; work that takes less than `EVERY` seconds says nothing.

    Args:
        what: is being done. unit: of what is counted, in the plural.
    """

    def __init__(self, what: str, unit: str, total: int) -> None:
        self.what, self.unit, self.total = what, unit, total
        self._said, self._done = time.monotonic(), 0

    def __call__(self, done: int) -> None:
        """So many are done: say so, if the last line is old enough and something has happened since."""
        if time.monotonic() - self._said >= EVERY and self._done < done < self.total:
            _log.info("%s: %d of %d %s", self.what, done, self.total, self.unit)
            self._said, self._done = time.monotonic(), done
