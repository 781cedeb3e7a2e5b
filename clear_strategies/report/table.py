"""Rows as a table: Markdown for readers, records for report.csv, cells for the page."""

from __future__ import annotations

import html
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from clear_strategies.outputs.metrics import NOTE
from clear_strategies.report.rows import Row, mean, shared_settings

# Quantity -> header of its column, and how its numbers are written.
QUANTITIES: Final = {
    "psnr": ("PSNR (dB) ↑", ".2f"),
    "ssim": ("SSIM ↑", ".4f"),
    "gmsd": ("GMSD ↓", ".4f"),
    "blur": ("blur → 0", "+.4f"),
    "conflict": ("conflict", ".3f"),
    "gaussians": ("Gaussians", ",.0f"),
    "seconds": ("seconds", ",.0f"),
}

Columns = dict[str, list[str]]
"""header -> cells."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns without those that are empty throughout, and what a reader has to know about them."""

    columns: Columns
    notes: Sequence[str] = field(default=())

    @property
    def markdown(self) -> str:
        return "\n".join((*aligned(self.columns), "", *(html.escape(note, quote=False) for note in self.notes), ""))


def layout(rows: Sequence[Row], *, beside: Mapping[str, Columns] | None = None, notes: Sequence[str] = ()) -> Table:
    """The table of these rows.

    Args:
        beside: quantity -> columns that stand right of it.
        notes: added to the table's own.
    """
    cells: Columns = {"scene": [row.scene for row in rows], "method": [row.method for row in rows]}
    for quantity, (header, form) in QUANTITIES.items():
        cells[header] = [_number(row, quantity, form) for row in rows]
        if beside is not None:
            cells |= beside.get(quantity, {})
        if quantity == "psnr":
            several = any(row.delta is not None and abs(row.delta.mean) > 0 for row in rows)
            cells["Δ"] = [str(row.delta) if several and row.delta is not None else "" for row in rows]
            cells["best"] = [_best(row) for row in rows]
    cells["seeds"] = [row.seeds for row in rows]
    return Table({name: column for name, column in cells.items() if any(column)}, [*_notes(rows, cells), *notes])


def record(row: Row) -> dict[str, Any]:
    """A line of report.csv: plain numbers."""
    line: dict[str, Any] = {"scene": row.scene, "method": row.method, "runs": len(row.runs), "seeds": row.seeds}
    for quantity in QUANTITIES:
        values = row.values.get(quantity, ())
        line[quantity] = mean(values)
        line[f"{quantity}_std"] = statistics.stdev(values) if row.runs and len(values) > 1 else math.nan
        if quantity == "psnr":
            line["psnr_best"] = max(values, default=math.nan) if row.runs else math.nan
            line["psnr_delta"] = math.nan if row.delta is None else row.delta.mean
            line["psnr_delta_error"] = math.nan if row.delta is None else row.delta.error
            line["psnr_delta_pairs"] = "" if row.delta is None else row.delta.pairs
    return line


def aligned(columns: Mapping[str, Sequence[str]]) -> list[str]:
    """The lines of a Markdown table whose columns also align in a terminal."""
    escaped = [[_plain(cell) for cell in (name, *cells)] for name, cells in columns.items()]
    widths = [max(map(len, cells)) for cells in escaped]
    lines = [
        "| " + " | ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)) + " |"
        for cells in zip(*escaped, strict=True)
    ]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]


def _plain(cell: str) -> str:
    """A cell that Markdown shows as it is: names of scenes and methods come from files, and Markdown may hold HTML."""
    return html.escape(" ".join(cell.split()), quote=False).replace("|", "\\|")


def _notes(rows: Sequence[Row], cells: Columns) -> list[str]:
    notes = [f"{NOTE[0].upper()}{NOTE[1:]}."]
    if any(cells["Δ"]):
        with_error = any(row.delta is not None and not math.isnan(row.delta.error) for row in rows)
        how = "; its ±: standard error of the differences seed by seed" * with_error
        notes.append(f"Δ: PSNR over the scene's first method, dB{how}.")
    if any(cells["best"]):
        notes.append("±: standard deviation over seeds; best: PSNR of the best seed.")
    if any(row.is_average for row in rows):
        notes.append("Averages are means of the scenes' means; their Δ is paired over scenes and seeds.")
    for scene in dict.fromkeys(row.scene for row in rows if not row.is_average):
        if shared := shared_settings([run for row in rows if row.scene == scene for run in row.runs]):
            notes.append(f"All runs of {scene}: `{' '.join(shared)}`.")
    return notes


def _number(row: Row, quantity: str, form: str) -> str:
    """The mean, ± the standard deviation over seeds. Scenes differ in difficulty, so an average has no ±."""
    values = row.values.get(quantity, ())
    if not values:
        return ""
    middle = format(mean(values), form)
    if row.is_average or len(values) == 1:
        return middle
    return f"{middle} ± {statistics.stdev(values):{form.lstrip('+')}}"


def _best(row: Row) -> str:
    several_seeds = not row.is_average and not row.is_baseline and len(row.values["psnr"]) > 1
    return f"{max(row.values['psnr']):.2f}" if several_seeds else ""
