"""The numbers of the paper's tables beside ours, for runs of its data sets.

They are in paper.csv: `ours` is the name of a run's method or strategies in this package, `source` the table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from clear_strategies.report.runs import OWN, FinishedRun
from clear_strategies.report.table import run_rows

NUMBERS: Final = Path(__file__).with_name("paper.csv")
NOTE: Final = (
    "The columns named paper are the paper's, means over all its scenes at its sizes; ours are means over the scenes that ran. "
    "A dash: not computed, as LPIPS without metrics.lpips, or not printed."
)
# The paper's data set of a protocol or scene (conf/protocol, conf/scene).
_DATA: Final[Mapping[str, str]] = {
    "llff_x4": "LLFF", "llff_x4_quarter": "LLFF", "fern": "LLFF", "horns": "LLFF", "blender_x4": "Blender",
    "lego": "Blender", "mip360_x4": "Mip-NeRF 360",
}  # fmt: skip
# Settings whose other values are not in the paper's tables.
_FIXED: Final = ("data.views.train", "data.views.sr_scale")
_COLUMNS: Final = {
    "psnr": ("PSNR (dB)", ".2f"), "ssim": ("SSIM", ".3f"), "lpips": ("LPIPS", ".3f"), "conflict": ("conflict", ".3f"),
    "seconds": ("seconds", ",.0f"),
}  # fmt: skip


def data_of(run: FinishedRun) -> str | None:
    """The paper's data set of a run; None if it is of none, or has another number of views or scale."""
    return None if any(s.lstrip("+").startswith(_FIXED) for s in run.settings) else _DATA.get(run.protocol or "")


def beside(runs: Sequence[FinishedRun]) -> dict[str, pd.DataFrame]:
    """The paper's rows for each of its data sets among the runs, as text, with ours beside them, one row per set of settings."""
    numbers = pd.read_csv(NUMBERS)
    return {
        data: _beside(rows, [run for run in runs if data_of(run) == data])
        for data, rows in numbers.groupby("data", sort=False)
        if any(data_of(run) == data and _row(run) in set(rows["ours"]) for run in runs)
    }


def _beside(printed: pd.DataFrame, runs: Sequence[FinishedRun]) -> pd.DataFrame:
    single = run_rows(runs).rename(columns={f"{OWN}lpips": "lpips"})
    single["row"] = single["run"].map(_row)
    by_scene = single.groupby(["row", "label", "scene"], sort=False).mean(numeric_only=True)
    means = by_scene.groupby(["row", "label"], sort=False).mean().reindex(columns=[*_COLUMNS]).reset_index()
    paper = {quantity: f"{quantity}_paper" for quantity in _COLUMNS}
    table = printed.rename(columns=paper).merge(means, "left", left_on="ours", right_on="row")
    cells = {"method": table["method"] + table["label"].fillna("")}
    for quantity, (header, form) in _COLUMNS.items():
        if table[paper[quantity]].notna().any():
            cells[header] = [_number(value, form) for value in table[quantity]]
            cells[f"{header}, paper"] = [_number(value, form) for value in table[paper[quantity]]]
    return pd.DataFrame({**cells, "source": table["source"]})


def _row(run: FinishedRun) -> str:
    return "clear" if run.name == "clear_paper" else run.name


def _number(value: float, form: str) -> str:
    return "–" if pd.isna(value) else f"{value:{form}}"
