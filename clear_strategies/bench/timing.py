"""Contenders take turns, so that other work on the machine slows all of them alike.

On a CPU times are wall-clock. On CUDA they are taken between events on torch's current stream (`WorkLog`). `queued` keeps
the device busy until the host has launched a stage, whose time is then the device's; where the host has to wait for the device
within a stage, that wait is a part of it, as in a training loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Final

import pandas as pd
import torch
from tqdm import tqdm

from clear_strategies.core.work_log import WorkLog

Contender = Callable[[], Mapping[str, float]]
"""Runs all its stages once and returns the milliseconds of each."""

WARM_UPS: Final = {"cpu": 1, "cuda": 3}
"""Rounds that do not count: kernels are compiled, buffers grow and clocks rise in them."""

_AHEAD: Final = 20_000_000
"""Cycles of a GPU, about 10 ms: more than the host needs to launch a stage."""


@contextmanager
def queued(work_log: WorkLog, stage: str) -> Iterator[None]:
    """A stage that a CUDA device begins after other work, so that it does not start idle and measure how the host launches."""
    if work_log.device.type == "cuda":
        torch.cuda._sleep(_AHEAD)  # type: ignore[no-untyped-call]
    with work_log.stage(stage):
        yield


def milliseconds(work_log: WorkLog) -> dict[str, float]:
    """The time of each stage."""
    return {name: 1e3 * entry.seconds for name, entry in work_log.entries.items()}


def interleaved(contenders: Mapping[str, Contender], repeats: int, *, device: str, label: str) -> pd.DataFrame:
    """Time the contenders round robin; one row for each stage of each turn."""
    rows = [
        {"contender": name, "turn": turn, "stage": stage, "ms": ms}
        for turn in tqdm(range(-WARM_UPS[device], repeats), desc=label, unit="turn", leave=False)
        for name, contender in contenders.items()
        for stage, ms in contender().items()
    ]
    return pd.DataFrame(rows).query("turn >= 0")


def medians(turns: pd.DataFrame) -> pd.DataFrame:
    """Median milliseconds: one row per contender, one column per stage."""
    return turns.pivot_table("ms", "contender", "stage", aggfunc="median", sort=False)
