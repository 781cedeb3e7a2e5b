"""Taking times: contenders take turns, so that the machine's other work hits all of them alike."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch

from clear_strategies.ledger import Ledger

Milliseconds = Mapping[str, float]  # by stage
Contender = Callable[[], Milliseconds]  # each call is one turn: all its stages once


def milliseconds(ledger: Ledger) -> Milliseconds:
    """What one turn took, by stage."""
    return {name: 1e3 * entry.seconds for name, entry in ledger.entries.items()}


@contextmanager
def timed(ledger: Ledger, stage: str, device: str) -> Iterator[None]:
    """A stage until its work is done: CUDA only queues it."""
    with ledger.stage(stage):
        yield
        if device == "cuda":
            torch.cuda.synchronize()


def interleaved(
    contenders: Mapping[str, Contender], repeats: int, *, progress: Callable[[], object] = lambda: None
) -> dict[str, dict[str, list[float]]]:
    """Contender -> stage -> ms of every repeat, round robin, after one round that does not count (caches, lists)."""
    times: dict[str, dict[str, list[float]]] = {name: {} for name in contenders}
    for turn in range(repeats + 1):
        for name, contender in contenders.items():
            ms = contender()
            progress()
            if turn > 0:
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
