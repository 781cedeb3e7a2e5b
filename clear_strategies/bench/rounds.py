"""Taking times: contenders take turns, so that the machine's other work hits all of them alike.

On a CPU times are wall-clock. On CUDA they are between events on torch's current stream (`WorkLog`), and the device is
waited for between turns alone, so that a stage costs what it costs in a loop: its kernels, and the host where they wait
for it.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

from clear_strategies.core.work_log import WorkLog

Milliseconds = Mapping[str, float]  # by stage
Contender = Callable[[], Milliseconds]  # each call is one turn: all its stages once

WARM_UPS: Final = {"cpu": 1, "cuda": 3}
"""Rounds that do not count: in the first kernels are compiled and lists find their length, then clocks rise."""


def milliseconds(work_log: WorkLog) -> Milliseconds:
    """What one turn took, by stage."""
    return {name: 1e3 * entry.seconds for name, entry in work_log.entries.items()}


def interleaved(
    contenders: Mapping[str, Contender],
    repeats: int,
    *,
    warm_ups: int = WARM_UPS["cpu"],
    progress: Callable[[], object] = lambda: None,
) -> dict[str, dict[str, list[float]]]:
    """Contender -> stage -> ms of every repeat, round robin, after rounds that do not count."""
    times: dict[str, dict[str, list[float]]] = {name: {} for name in contenders}
    for turn in range(warm_ups + repeats):
        for name, contender in contenders.items():
            ms = contender()
            progress()
            if turn >= warm_ups:
                for stage, value in ms.items():
                    times[name].setdefault(stage, []).append(value)
    return times


def medians(times: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """By stage."""
    return {stage: statistics.median(values) for stage, values in times.items()}


@contextmanager
def bar(total: int, label: str) -> Iterator[Callable[[], object]]:
    """Progress on stderr, gone when done."""
    from tqdm import tqdm

    every = 0.5 if sys.stderr.isatty() else 15  # seconds; a log file needs no animation
    with tqdm(total=total, desc=label, unit="turn", leave=False, dynamic_ncols=True, mininterval=every) as shown:
        yield lambda: shown.update(1)
