"""Timing of contenders, and the results of a benchmark: tables as CSV, figures as PNG, and the machine as JSON.

Contenders take turns, so that other work on the machine slows all of them alike. Times are wall-clock on a CPU, and between
events on torch's current stream on CUDA (`WorkLog`). `queued` keeps the device busy until the host has launched a stage, so that
the time of the stage is the device's. If the host waits for the device within a stage, the wait is included, as in a training
loop.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pandas as pd
import torch
from matplotlib.figure import Figure
from torch.utils import collect_env
from tqdm import tqdm

from clear_strategies import files
from clear_strategies.core.work_log import WorkLog
from clear_strategies.outputs.figures import save
from clear_strategies.outputs.provenance import provenance
from rasterizers import native

_log = logging.getLogger(__name__)

Contender = Callable[[], Mapping[str, float]]
"""Runs its stages once and returns the milliseconds of each."""
WARM_UPS: Final = {"cpu": 1, "cuda": 3}
"""Turns that do not count: kernels are compiled, buffers grow and clocks rise in them."""
_AHEAD: Final = 20_000_000
"""GPU cycles of about 10 ms, more than the host needs to launch a stage."""


@dataclass(slots=True, eq=False)
class Results:
    """The results of one benchmark.

    Args:
        out: the folder to write to; None: nothing is written.
        notes: remarks for readers of the tables, e.g. reasons why a contender was not measured.
    """

    out: Path | None = None
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    figures: dict[str, Figure] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def note(self, line: str) -> None:
        """Log a line and keep it."""
        _log.info("%s", line)
        self.notes.append(line)

    def text(self) -> str:
        """Format the tables for a terminal, without the single turns."""
        shown = {name: table for name, table in self.tables.items() if not name.endswith("turns")}
        written = {n: t.to_string(index=False, na_rep="", float_format="{:.3g}".format) for n, t in shown.items()}
        return "\n\n".join((*(f"{name}\n{table}" for name, table in written.items()), *self.notes)) + "\n"

    def write(self, question: str, options: Mapping[str, Any]) -> None:
        """Write `<table>.csv`, `<figure>.png` and `<question>.json`, which contains these options of the command."""
        if self.out is None:
            return
        for name, table in self.tables.items():
            files.write_text(self.out / f"{name}.csv", table.to_csv(index=False, float_format="%.6g"))
        for name, figure in self.figures.items():
            save(figure, self.out / f"{name}.png")
        system = collect_env.get_env_info()  # type: ignore[no-untyped-call]
        names = ("os", "gcc_version", "nvidia_gpu_models", "nvidia_driver_version", "cuda_runtime_version")
        machine = provenance(threads=native.threads(), torch=torch.__version__, torch_threads=torch.get_num_threads())
        machine |= {name: getattr(system, name) for name in names}
        del machine["command"]  # it may name a folder, or a user
        facts = {"options": options, "machine": machine, "notes": self.notes}
        files.write_json(self.out / f"{question}.json", facts)


@contextmanager
def queued(work_log: WorkLog, stage: str) -> Iterator[None]:
    """Time a stage that a CUDA device starts after other work: on an idle device, the host's launches would be timed."""
    if work_log.device.type == "cuda":
        torch.cuda._sleep(_AHEAD)  # type: ignore[no-untyped-call]  # without a public name; since torch 1.0
    with work_log.stage(stage):
        yield


def milliseconds(work_log: WorkLog) -> dict[str, float]:
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
