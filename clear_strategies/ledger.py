"""Floor 0: what was computed, what was skipped and why, and how long it took. Written as timing.csv after a run."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(slots=True)
class Entry:
    """One stage: how often it ran, for how many seconds in all, and how often each reason kept it from running."""

    runs: int = 0
    seconds: float = 0.0
    skipped: dict[str, int] = field(default_factory=dict)


class Ledger:
    """Stages by name, in the order they first appeared."""

    def __init__(self) -> None:
        self.entries: dict[str, Entry] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count and time a block; seconds are wall-clock and stages do not nest."""
        start = time.perf_counter()
        try:
            yield
        finally:
            entry = self.entries.setdefault(name, Entry())
            entry.runs += 1
            entry.seconds += time.perf_counter() - start

    def skip(self, name: str, reason: str, count: int = 1) -> None:
        """Count a block that was not needed, or `count` rows of one."""
        skipped = self.entries.setdefault(name, Entry()).skipped
        skipped[reason] = skipped.get(reason, 0) + count

    def rows(self) -> list[dict[str, str | int | float]]:
        """One row a stage: runs, ms each, seconds, and the skips with what they saved at that price."""
        table: list[dict[str, str | int | float]] = []
        for name, entry in self.entries.items():
            each = entry.seconds / entry.runs if entry.runs else 0.0
            skips = sum(entry.skipped.values())
            table.append(
                {
                    "stage": name,
                    "runs": entry.runs,
                    "ms_each": round(each * 1e3, 3),
                    "seconds": round(entry.seconds, 3),
                    "skipped": skips,
                    "seconds_saved": round(each * skips, 3),
                    "why": "; ".join(f"{reason} ({count}x)" for reason, count in entry.skipped.items()),
                }
            )
        return table

    def state_dict(self) -> dict[str, Any]:
        """JSON-ready, for a checkpoint."""
        return {name: asdict(entry) for name, entry in self.entries.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Count on from there."""
        self.entries = {name: Entry(**entry) for name, entry in state.items()}
