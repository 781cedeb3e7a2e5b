"""What a question found: tables as CSV, figures as PNG, and the machine they belong to as JSON."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pandas as pd
import torch
from matplotlib.figure import Figure
from torch.utils import collect_env

from clear_strategies import files
from clear_strategies.outputs.figures import save_png
from clear_strategies.outputs.provenance import provenance

ROOT: Final = Path(__file__).resolve().parents[2]


@dataclass(slots=True, eq=False)
class Results:
    """Everything one question found.

    Args:
        question: prefix of all file names.
        log: prints a line while measuring.
        options: those of the command that a reader must know.
        notes: what was not measured and why, and what else a reader of the tables must know.
    """

    question: str
    log: Callable[[str], None]
    options: dict[str, Any] = field(default_factory=dict)
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

    def write(self, out: Path) -> None:
        """Write `<table>.csv`, `<figure>.png` and `<question>.json` into a folder."""
        for name, table in self.tables.items():
            files.write_text(out / f"{name}.csv", table.to_csv(index=False, float_format="%.6g"))
        for name, figure in self.figures.items():
            save_png(figure, out / f"{name}.png")
        facts = {"options": self.options, "machine": machine(), "notes": self.notes}
        files.write_json(out / f"{self.question}.json", facts)


def machine() -> dict[str, Any]:
    """Hardware and versions; nothing that names a user or a folder."""
    facts, system = provenance(), collect_env.get_env_info()  # type: ignore[no-untyped-call]
    names = ("os", "gcc_version", "nvidia_gpu_models", "nvidia_driver_version", "cuda_runtime_version")
    return {
        **{name: value for name, value in facts.items() if name != "command"},
        **{name: getattr(system, name) for name in names},
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
    }


def environment(**more: str) -> dict[str, str]:
    """Of a child process that imports this very package."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": paths, **more}
