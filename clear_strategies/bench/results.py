"""The results of a question: tables as CSV, figures as PNG, and the machine that they were measured on as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from matplotlib.figure import Figure
from torch.utils import collect_env

from clear_strategies import files
from clear_strategies.outputs.figures import save_png
from clear_strategies.outputs.provenance import provenance


@dataclass(slots=True, eq=False)
class Results:
    """The results of one question.

    Args:
        log: prints a line while measuring.
        out: the folder to write to; None: nothing is written.
        notes: what was not measured and why, and what else a reader of the tables must know.
    """

    log: Callable[[str], None]
    out: Path | None = None
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    figures: dict[str, Figure] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def note(self, line: str) -> None:
        """Log a line and keep it."""
        self.log(line)
        self.notes.append(line)

    def text(self) -> str:
        """The tables for a terminal, without the single turns."""
        shown = {name: table for name, table in self.tables.items() if not name.endswith("turns")}
        written = {n: t.to_string(index=False, na_rep="", float_format="{:.3g}".format) for n, t in shown.items()}
        return "\n\n".join((*(f"{name}\n{table}" for name, table in written.items()), *self.notes)) + "\n"

    def write(self, question: str, options: Mapping[str, Any]) -> None:
        """Write `<table>.csv`, `<figure>.png` and `<question>.json`, which holds these options of the command."""
        if self.out is None:
            return
        for name, table in self.tables.items():
            files.write_text(self.out / f"{name}.csv", table.to_csv(index=False, float_format="%.6g"))
        for name, figure in self.figures.items():
            save_png(figure, self.out / f"{name}.png")
        system = collect_env.get_env_info()  # type: ignore[no-untyped-call]
        names = ("os", "gcc_version", "nvidia_gpu_models", "nvidia_driver_version", "cuda_runtime_version")
        machine = provenance(torch=torch.__version__, torch_threads=torch.get_num_threads())
        machine |= {name: getattr(system, name) for name in names}
        del machine["command"]  # it may name a folder, or a user
        facts = {"options": options, "machine": machine, "notes": self.notes}
        files.write_json(self.out / f"{question}.json", facts)
