"""Counts and times of the stages of a run, and of skipped work with the reason; a run writes them as timing.csv.

On CUDA nothing waits while training: stages are timed by CUDA events, skips on the device are summed there, and both are
read when the log is read or once the device has passed them.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import torch
from jaxtyping import Shaped
from torch import Tensor

if sys.platform != "win32":
    import resource

_MIB: Final = 1024 if sys.platform != "darwin" else 1 << 20  # units of ru_maxrss
_BATCH: Final = 1024  # pairs of events that are kept before those that the device has passed are read


@dataclass(slots=True)
class Entry:
    """One stage: how often it ran, for how many seconds in all, and how often each reason kept it from running.

    Args:
        peak: MiB, see `peak_mib`, at its last end.
    """

    runs: int = 0
    seconds: float = 0.0
    peak: int = 0
    skipped: dict[str, int] = field(default_factory=dict)


class WorkLog:
    """Stages by name, in the order they first appeared.

    Args:
        device: where the work runs; may be set until the first stage. On "cuda" a stage's seconds are measured by events
            on the stream that is current at its beginning and at its end.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self._entries: dict[str, Entry] = {}
        self._stamped: deque[tuple[Entry, Any, Any]] = deque()
        self._counted: dict[tuple[str, str], Tensor] = {}
        self._noted: list[tuple[str, str, int | Tensor]] | None = None

    @property
    def entries(self) -> dict[str, Entry]:
        """All stages; waits for the device to finish them."""
        self._read_stamps(wait=True)
        counted, self._counted = self._counted, {}
        for (name, reason), count in counted.items():
            if (skips := int(count)) > 0:  # a count on the device may turn out to be 0
                self._add(name, reason, skips)
        return self._entries

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Count and time a block. Seconds are wall-clock on the CPU and device time on CUDA. Stages do not nest, and in a scope
        of `noted` they are neither counted nor timed.
        """
        if self._noted is not None:
            return nullcontext()
        return _Stage(self, name)

    def skip(self, name: str, reason: str, count: int | Shaped[Tensor, ""] = 1) -> None:
        """Count a skipped block, or `count` skipped rows of one; a count on the device is read later."""
        if self._noted is not None:
            self._noted.append((name, reason, count))
        elif not isinstance(count, Tensor):
            self._add(name, reason, count)
        elif (name, reason) in self._counted:
            self._counted[name, reason] += count
        else:
            self._counted[name, reason] = count.to(torch.float64, copy=True)  # the caller may overwrite its tensor

    @contextmanager
    def noted(self) -> Iterator[list[tuple[str, str, int | Tensor]]]:
        """A scope of recorded work, whose skips are not counted: it returns a list of the arguments of each `skip`."""
        self._noted = []
        try:
            yield self._noted
        finally:
            self._noted = None

    def rows(self) -> list[dict[str, str | int | float]]:
        """One row per stage: runs, ms per run, seconds, the process's peak of memory at its last end, skips, and the seconds that
        these saved at that rate. A stage whose peak is above that of all earlier stages needs that memory.
        """
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
                    "peak_mib": entry.peak,
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
        self._stamped.clear()
        self._counted.clear()
        self._entries = {name: Entry(**entry) for name, entry in state.items()}

    def _ended(self, name: str, start: Any) -> None:
        entry = self._entries.setdefault(name, Entry())
        entry.runs += 1
        entry.peak = peak_mib()
        if self.device.type == "cuda":
            self._stamped.append((entry, start, _stamp(self.device)))
            if len(self._stamped) >= _BATCH:
                self._read_stamps(wait=False)
        else:
            entry.seconds += time.perf_counter() - start

    def _add(self, name: str, reason: str, count: int) -> None:
        skipped = self._entries.setdefault(name, Entry()).skipped
        skipped[reason] = skipped.get(reason, 0) + count

    def _read_stamps(self, *, wait: bool) -> None:
        """Turn pairs of events into seconds: those that the device has passed, or all if `wait`."""
        while self._stamped and (wait or self._stamped[0][2].query()):
            entry, start, end = self._stamped.popleft()
            end.synchronize()
            entry.seconds += start.elapsed_time(end) / 1e3


def peak_mib() -> int:
    """The process's peak of main memory so far, MiB; 0 on a system that does not report it."""
    if sys.platform == "win32":
        return 0
    else:  # noqa: RET505 - as mypy knows platforms
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // _MIB


class _Stage:
    """A timed block. A generator would take three times as long, in eight stages of every iteration."""

    __slots__ = ("_log", "_name", "_start")

    def __init__(self, log: WorkLog, name: str) -> None:
        self._log, self._name = log, name

    def __enter__(self) -> None:
        self._start = _stamp(self._log.device) if self._log.device.type == "cuda" else time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._log._ended(self._name, self._start)


def _stamp(device: torch.device) -> Any:
    """A CUDA event, recorded on the device's current stream. The device need not be the current one."""
    event: Any = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
    event.record(torch.cuda.current_stream(device))
    return event
