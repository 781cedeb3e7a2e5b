"""Log lines about the progress of long work."""

from __future__ import annotations

import logging
import time
from typing import Final

_log = logging.getLogger(__name__)

EVERY: Final = 10.0  # seconds between two lines


class Progress:
    """Logs how much is done, at most every `EVERY` seconds.

    Args:
        what: the work. unit: what is counted, in the plural.
    """

    def __init__(self, what: str, unit: str, total: int) -> None:
        self.what, self.unit, self.total = what, unit, total
        self._logged_at, self._done = time.monotonic(), 0

    def __call__(self, done: int) -> None:
        """Log that `done` of `total` are done, if the last line is old enough and `done` has grown since."""
        if time.monotonic() - self._logged_at >= EVERY and self._done < done < self.total:
            _log.info("%s: %d of %d %s", self.what, done, self.total, self.unit)
            self._logged_at, self._done = time.monotonic(), done
