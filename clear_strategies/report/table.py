"""Runs as one table: which of them share a line, their means, and how far each method is from the first.

Differences are taken seed by seed where two methods share seeds: what the seed does to both is then no part of the error.
"""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, runtime_checkable

from clear_strategies.outputs.metrics import NOTE
from clear_strategies.report.runs import BASELINES, SCORES, Run

_log = logging.getLogger(__name__)

# What a run is measured by: column of the Markdown table, and how its numbers are written.
QUANTITIES: Final = {
    "psnr": ("PSNR (dB) ↑", ".2f"),
    "ssim": ("SSIM ↑", ".4f"),
    "gmsd": ("GMSD ↓", ".4f"),
    "blur": ("blur → 0", "+.4f"),
    "conflict": ("conflict", ".3f"),
    "gaussians": ("Gaussians", ",.0f"),
    "seconds": ("seconds", ",.0f"),
}
# Overrides that choose what the baselines see.
_INPUT: Final = ("data", "prior", "experiment")

Columns = dict[str, list[str]]
"""header -> cells."""


@dataclass(frozen=True, slots=True)
class Difference:
    """PSNR of a method over that of the first, dB.

    Args:
        mean: of the pairs; of two means where fewer than two seeds are shared.
        error: standard error of the mean over pairs; NaN where there are fewer than two.
        pairs: how many seeds (of an average: scenes and seeds) both methods have.
    """

    mean: float
    error: float = math.nan
    pairs: int = 0

    def __str__(self) -> str:
        if math.isnan(self.mean):
            return ""
        return f"{self.mean:+.2f}" + ("" if math.isnan(self.error) else f" ± {self.error:.2f}")


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One line of the table: a method on a scene, or its average over scenes.

    Args:
        method: the runs' name and what sets them apart; `name` is the first alone.
        runs: those averaged; they differ in their seed only. Empty for an average over scenes.
        values: quantity -> what each run measured (of an average: each scene's mean), NaN left out.
        delta: PSNR over that of the scene's first method; None for a baseline.
    """

    scene: str
    method: str
    name: str
    runs: tuple[Run, ...]
    values: Mapping[str, Sequence[float]]
    delta: Difference | None = None

    @property
    def baseline(self) -> bool:
        return self.delta is None

    @property
    def seeds(self) -> str:
        return "" if self.baseline else ", ".join(map(str, sorted({run.seed for run in self.runs})))


@runtime_checkable
class Beside(Protocol):
    """Other people's numbers for the same rows."""

    def columns(self, rows: Sequence[Row]) -> Mapping[str, Columns]:
        """What stands right of each quantity: cells by header, one for each row."""
        ...

    def notes(self) -> Sequence[str]:
        """What their reader must know, and what else they published."""
        ...


def table(runs: Sequence[Run]) -> list[Row]:
    """Scene by scene in the order of the runs: its baselines, then one row per method; then averages over scenes."""
    scenes = _grouped(runs, lambda run: run.scene)
    rows = {scene: [*_baseline_rows(of_scene), *_method_rows(of_scene)] for scene, of_scene in scenes.items()}
    averages = []
    # Scores against LR photos, or of training views, have no average with others.
    for marks, same in _grouped([of_scene[0] for of_scene in scenes.values()], lambda run: run.marks).items():
        averages += _averages([rows[run.scene] for run in same], marks)
    return [row for of_scene in rows.values() for row in of_scene] + averages


def columns(rows: Sequence[Row], beside: Beside | None = None) -> tuple[Columns, list[str]]:
    """The cells by column, without columns that say nothing, and what their reader must know."""
    cells: Columns = {
        "scene": [row.scene for row in rows],
        "method": [row.method for row in rows],
    }
    others = {} if beside is None else beside.columns(rows)
    for quantity, (header, form) in QUANTITIES.items():
        cells[header] = [_spread(row, quantity, form) for row in rows]
        cells |= others.get(quantity, {})
        if quantity == "psnr":
            several = any(row.delta is not None and abs(row.delta.mean) > 0 for row in rows)
            cells["Δ"] = [str(row.delta) if several and row.delta is not None else "" for row in rows]
            cells["best"] = [
                f"{max(row.values['psnr']):.2f}"
                if row.runs and not row.baseline and len(row.values["psnr"]) > 1
                else ""
                for row in rows
            ]
    cells["seeds"] = [row.seeds for row in rows]
    notes = [f"{NOTE[0].upper()}{NOTE[1:]}."]
    if any(cells["Δ"]):
        with_error = any(row.delta is not None and not math.isnan(row.delta.error) for row in rows)
        how = "; its ±: standard error of the differences seed by seed" * with_error
        notes.append(f"Δ: PSNR over the scene's first method, dB{how}.")
    if any(cells["best"]):
        notes.append("±: standard deviation over seeds; best: PSNR of the best seed.")
    if any(not row.runs for row in rows):
        notes.append("Averages are means of the scenes' means; their Δ is paired over scenes and seeds.")
    for scene in dict.fromkeys(row.scene for row in rows if row.runs):
        if shared := _shared([run for row in rows if row.scene == scene for run in row.runs]):
            notes.append(f"All runs of {scene}: `{' '.join(shared)}`.")
    if beside is not None:
        notes += beside.notes()
    return {name: column for name, column in cells.items() if any(column)}, notes


def markdown(rows: Sequence[Row], beside: Beside | None = None) -> str:
    """The table and its notes."""
    cells, notes = columns(rows, beside)
    return "\n".join((*aligned(cells), "", *notes, ""))


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
    """A Markdown table that is also one in a terminal."""
    escaped = [[cell.replace("|", "\\|") for cell in (name, *cells)] for name, cells in columns.items()]
    widths = [max(map(len, cells)) for cells in escaped]
    lines = [
        "| " + " | ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)) + " |"
        for cells in zip(*escaped, strict=True)
    ]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]


def mean(values: Sequence[float]) -> float:
    """NaN of nothing."""
    return sum(values) / len(values) if values else math.nan


def paired(own: Sequence[float], first: Sequence[float], pairs: Sequence[float]) -> Difference:
    """Of two methods' values, and of their differences where they share a seed."""
    if len(pairs) < 2:
        return Difference(mean(own) - mean(first), pairs=len(pairs))
    return Difference(mean(pairs), statistics.stdev(pairs) / math.sqrt(len(pairs)), len(pairs))


def _baseline_rows(runs: Sequence[Run]) -> list[Row]:
    """Of one scene: one row a baseline, or one for each input (data, prior) where the runs differ in it."""
    shared = _shared(runs)
    rows = []
    for baseline in BASELINES:
        by_input: dict[str, list[Run]] = {}
        for run in (run for run in runs if baseline in run.scores):
            inputs = [s for s in run.settings if _is_input(s)]
            by_input.setdefault(_label(baseline, inputs, shared), []).append(run)
        for label, same in by_input.items():
            # Runs with one input have one baseline; a prior that depends on the seed has several.
            values = {m: sorted(set(_known(run.scores[baseline][m] for run in same))) for m in SCORES}
            rows.append(Row(same[0].scene, label, baseline, tuple(same), values))
    return rows


def _method_rows(runs: Sequence[Run]) -> list[Row]:
    """Of one scene: one row for each name and set of settings."""
    shared = _shared(runs)
    rows: list[Row] = []
    for method, same in _grouped(runs, lambda run: _label(run.name, run.settings, shared)).items():
        if len(same) > len({run.seed for run in same}):
            _log.warning("%s, %s: a row holds several runs with the same seed.", same[0].scene, method)
        values = {measure: _known(run.scores["ours"][measure] for run in same) for measure in SCORES}
        if len(values["psnr"]) < len(same):
            _log.warning("%s, %s: runs without a finite PSNR are left out of its mean.", same[0].scene, method)
        for fact in same[0].facts:
            values[fact] = _known(run.facts[fact] for run in same)
        first = rows[0] if rows else Row(same[0].scene, method, same[0].name, tuple(same), values)
        delta = paired(values["psnr"], first.values["psnr"], _pairs(same, first.runs)) if rows else Difference(0.0)
        rows.append(Row(same[0].scene, method, same[0].name, tuple(same), values, delta))
    return rows


def _averages(scenes: Sequence[Sequence[Row]], marks: str) -> list[Row]:
    """One row for each method that every one of several scenes has."""
    if len(scenes) < 2:
        return []
    title = f"average of {len(scenes)} scenes" + (f" ({marks})" if marks else "")
    tables = [_by_identity(of_scene) for of_scene in scenes]
    common = [identity for identity in tables[0] if all(identity in rows for rows in tables)]
    left_out = [row.method for rows in tables for identity, row in rows.items() if identity not in common]
    if left_out:
        _log.info("%s: left out, for not every scene has it: %s.", title, "; ".join(dict.fromkeys(left_out)))
    methods = [settings for name, settings in common if name not in BASELINES]
    shared = [s for s in methods[0] if all(s in settings for settings in methods)] if methods else []
    averages: list[Row] = []
    first: list[Row] = []  # one a scene
    for identity in common:
        rows = [of_scene[identity] for of_scene in tables]
        values = {q: [mean(row.values[q]) for row in rows if row.values.get(q)] for q in QUANTITIES}
        values = {q: means for q, means in values.items() if len(means) == len(rows)}
        delta = None
        if not rows[0].baseline:
            first = first or rows
            pairs = [d for row, start in zip(rows, first, strict=True) for d in _pairs(row.runs, start.runs)]
            psnr = [mean(row.values["psnr"]) for row in first]
            delta = Difference(0.0) if rows is first else paired(values.get("psnr", ()), psnr, pairs)
        averages.append(Row(title, _label(*identity, shared), rows[0].name, (), values, delta))
    return averages


def _by_identity(rows: Sequence[Row]) -> dict[tuple[str, tuple[str, ...]], Row]:
    """Of one scene: name and settings -> row. What all its runs say about their data belongs to the scene."""
    shared = _shared([run for row in rows for run in row.runs])
    found = {}
    for row in rows:
        settings = [s for s in row.runs[0].settings if not (s in shared and _is_input(s, ("data",)))]
        if row.baseline:
            settings = [s for s in settings if _is_input(s)]
        found[row.name, tuple(sorted(settings))] = row
    return found


def _is_input(setting: str, groups: tuple[str, ...] = _INPUT) -> bool:
    return setting.lstrip("+~").startswith(groups)


def _pairs(runs: Sequence[Run], first: Sequence[Run]) -> list[float]:
    """PSNR over the first method's, for each seed that both have."""
    own, start = _by_seed(runs), _by_seed(first)
    return [own[seed] - start[seed] for seed in own if seed in start]


def _by_seed(runs: Sequence[Run]) -> dict[int, float]:
    found: dict[int, list[float]] = {}
    for run in runs:
        if not math.isnan(psnr := run.scores["ours"]["psnr"]):
            found.setdefault(run.seed, []).append(psnr)
    return {seed: mean(values) for seed, values in found.items()}


def _label(head: str, settings: Sequence[str], shared: Sequence[str]) -> str:
    return ", ".join((head, *(s for s in settings if s not in shared)))


def _shared(runs: Sequence[Run]) -> list[str]:
    """The settings that all runs have."""
    return [setting for setting in runs[0].settings if all(setting in run.settings for run in runs)]


def _grouped(runs: Iterable[Run], key: Callable[[Run], str]) -> dict[str, list[Run]]:
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return groups


def _known(values: Iterable[float]) -> list[float]:
    return [value for value in values if not math.isnan(value)]


def _spread(row: Row, quantity: str, form: str) -> str:
    values = row.values.get(quantity, ())
    if not values:
        return ""
    middle = format(mean(values), form)
    if not row.runs or len(values) == 1:  # scenes differ by what they show, which is no spread of the method
        return middle
    return f"{middle} ± {statistics.stdev(values):{form.lstrip('+')}}"
