"""`python -m clear_strategies.report DIR …`: a run, or a sweep, as one table (Markdown and CSV) and pictures.

Every folder below DIR with a metrics.json is a run. Runs of a scene that differ in nothing but their seed share a row:
mean ± standard deviation, and the best beside it. What all runs of a scene have in common is said once, below the table.
"""

from __future__ import annotations

import argparse
import csv
import logging
import math
import re
import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from clear_strategies import files, pictures
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import ClearError, DataError
from clear_strategies.metrics import NOTE

_log = logging.getLogger(__name__)

# What a run is measured by: column of the Markdown table, and how its numbers are written.
_QUANTITIES: Final = {
    "psnr": ("PSNR (dB) ↑", ".2f"),
    "ssim": ("SSIM ↑", ".4f"),
    "gmsd": ("GMSD ↓", ".4f"),
    "blur": ("blur → 0", "+.4f"),
    "conflict": ("conflict", ".3f"),
    "gaussians": ("Gaussians", ",.0f"),
    "seconds": ("seconds", ",.0f"),
}
_SCORES: Final = ("psnr", "ssim", "gmsd", "blur")
_BASELINES: Final = ("bicubic", "prior")

_SEED: Final = "fit.seed="
_STRATEGY: Final = "+strategy="
_METHOD: Final = "+method="
# Overrides that change no result, and those that choose what the baselines see.
_NEUTRAL: Final = ("hydra", "fit.resume=", "fit.threads=", "fit.keep=", "fit.checkpoint_every=", "fit.probe_")
_INPUT: Final = ("data", "prior", "experiment")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A finished run.

    Args:
        scene: its name, marked where the prior is synthetic or the scores are not those of HR.
        strategies: the method, or the strategies as they were asked for ("clear"), else as metrics.json lists them
            ("gco + p2g").
        settings: Hydra's overrides but for seed and strategies, without what changes no result.
        scores: method ("ours", "bicubic", "prior") -> measure -> mean over the test views; over the training views
            where there are no test views.
        facts: "conflict", "gaussians", "seconds"; NaN where unknown.
    """

    folder: Path
    scene: str
    strategies: str
    settings: tuple[str, ...]
    seed: int
    scores: Mapping[str, Mapping[str, float]]
    facts: Mapping[str, float]

    @classmethod
    def read(cls, folder: Path) -> Run:
        """Of the folder that the run left.

        Raises:
            DataError: metrics.json or .hydra/overrides.yaml is damaged.
        """
        path = folder / "metrics.json"
        content, overrides = read_object(path), _overrides(folder)
        try:
            part = content["test"] if content["test"]["mean"] else content["train"]
            marks = ["synthetic prior"] * bool(content["synthetic_prior"])
            marks += [] if content["test"]["mean"] else ["training views"]
            marks += [f"against {part['against']}"] if "LR" in part.get("against", "HR photos") else []
            methods = ("ours", *(baseline for baseline in _BASELINES if baseline in part["mean"]))
            return cls(
                folder=folder,
                scene=str(content["scene"]) + (f" ({', '.join(marks)})" if marks else ""),
                strategies=_strategies(overrides, content["strategies"]),
                settings=tuple(
                    o for o in overrides if not o.lstrip("+~").startswith((*_NEUTRAL, _SEED, "strategy=", "method="))
                ),
                seed=int(content["seed"]),
                scores={m: {s: _number(part["mean"][m][s]) for s in _SCORES} for m in methods},
                facts={
                    "conflict": _number(content["conflict"].get("gaussian")),
                    "gaussians": _number(content["gaussians"]),
                    "seconds": _number(content["seconds"]),
                },
            )
        except KeyError as error:
            raise DataError(path, str(error), "is missing", "train the run again") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise DataError(path, "content", f"is not what a run leaves ({error})", "train the run again") from error


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One line of the table: a method on a scene.

    Args:
        runs: those averaged; they differ in their seed only.
        values: quantity -> what each run measured, NaN left out.
        delta: PSNR over that of the scene's first method, dB; None for a baseline.
    """

    scene: str
    method: str
    runs: tuple[Run, ...]
    values: Mapping[str, Sequence[float]]
    delta: float | None = None

    @property
    def seeds(self) -> str:
        return "" if self.delta is None else ", ".join(map(str, sorted({run.seed for run in self.runs})))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 0, or 2 where there is nothing to report."""
    parser = argparse.ArgumentParser(
        prog="python -m clear_strategies.report", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="a run's folder, or a folder of runs")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where the report goes (default: the first DIR)")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        text = write(collect(options.folders), options.out or options.folders[0])
    except (ClearError, OSError) as error:
        _log.error("%s", error)
        return 2
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(text.encode(encoding, "replace").decode(encoding))  # a terminal may not know ↑
    return 0


def collect(folders: Iterable[Path]) -> list[Run]:
    """Every finished run at or below the folders, by path; what is unfinished or damaged is named and left out.

    Raises:
        DataError: there is none.
    """
    folders = list(folders)
    found = {path.parent.resolve(): None for folder in folders for path in _sorted(folder.rglob("metrics.json"))}
    for unfinished in _sorted(path.parent for folder in folders for path in folder.rglob(".hydra")):
        if unfinished.resolve() not in found:
            _log.warning("%s: left out, it has no metrics.json: the run did not finish.", unfinished)
    runs = []
    for folder in found:
        try:
            runs.append(Run.read(folder))
        except DataError as error:
            _log.warning("%s; left out.", error)
    if not runs:
        names = ", ".join(map(str, folders))
        raise DataError(names, "runs", "there is no finished run here", "give the folder of a run or of a sweep")
    return runs


def write(runs: Sequence[Run], out: Path) -> str:
    """Leave report.md, report.csv and each scene's comparison_*.png and curves_*.png in `out`; returns report.md."""
    rows = table(runs)
    text = markdown(rows)
    files.write_text(out / "report.md", text)
    records = [_record(row) for row in rows]
    files.write_csv(out / "report.csv", records, list(dict.fromkeys(key for record in records for key in record)))
    for scene in dict.fromkeys(row.scene for row in rows):
        # Of several seeds the first is shown.
        shown = {row.method: row.runs[0] for row in rows if row.scene == scene and row.delta is not None}
        name = re.sub(r"\W+", "_", scene).strip("_")
        _compare(out / f"comparison_{name}.png", scene, shown)
        histories = {method: _history(run.folder) for method, run in shown.items()}
        pictures.overlay(out / f"curves_{name}.png", histories, scene)
    _log.info("report of %d runs: %s", len(runs), out)
    return text


def table(runs: Sequence[Run]) -> list[Row]:
    """Scene by scene in the order of the runs: its baselines, then one row per method."""
    rows: list[Row] = []
    for of_scene in _grouped(runs, lambda run: run.scene).values():
        for baseline in _BASELINES:
            rows += _baseline_rows(baseline, of_scene)
        rows += _method_rows(of_scene)
    return rows


def markdown(rows: Sequence[Row]) -> str:
    """The table, without columns that say nothing, and what its reader must know."""
    columns: dict[str, list[str]] = {
        "scene": [row.scene for row in rows],
        "method": [row.method for row in rows],
    }
    for quantity, (header, form) in _QUANTITIES.items():
        columns[header] = [_spread(row.values.get(quantity, ()), form) for row in rows]
        if quantity == "psnr":
            deltas = [math.nan if row.delta is None else row.delta for row in rows]
            several = any(delta != 0 for delta in _known(deltas))
            columns["Δ"] = [f"{delta:+.2f}" if several and not math.isnan(delta) else "" for delta in deltas]
            columns["best"] = [
                f"{max(row.values['psnr']):.2f}" if row.delta is not None and len(row.values["psnr"]) > 1 else ""
                for row in rows
            ]
    columns["seeds"] = [row.seeds for row in rows]
    columns = {name: cells for name, cells in columns.items() if any(cells)}
    notes = [f"{NOTE[0].upper()}{NOTE[1:]}."]
    if "Δ" in columns:
        notes.append("Δ: PSNR over the scene's first method, dB.")
    if "best" in columns:
        notes.append("±: standard deviation over seeds; best: PSNR of the best seed.")
    for scene in dict.fromkeys(row.scene for row in rows):
        if shared := _shared([run for row in rows if row.scene == scene for run in row.runs]):
            notes.append(f"All runs of {scene}: `{' '.join(shared)}`.")
    return "\n".join((*aligned(columns), "", *notes, ""))


def _baseline_rows(baseline: str, runs: Sequence[Run]) -> list[Row]:
    """Of one scene: one row, or one for each input (data, prior) where the runs differ in it."""
    shared = _shared(runs)

    def of_input(run: Run) -> str:
        return _name(baseline, [s for s in run.settings if s.lstrip("+~").startswith(_INPUT)], shared)

    rows = []
    for name, same in _grouped([run for run in runs if baseline in run.scores], of_input).items():
        # Runs with one input have one baseline; a prior that depends on the seed has several.
        values = {measure: sorted(set(_known(run.scores[baseline][measure] for run in same))) for measure in _SCORES}
        rows.append(Row(same[0].scene, name, tuple(same), values))
    return rows


def _method_rows(runs: Sequence[Run]) -> list[Row]:
    """Of one scene: one row for each set of strategies and settings."""
    shared = _shared(runs)
    rows: list[Row] = []
    first = math.nan
    for method, same in _grouped(runs, lambda run: _name(run.strategies, run.settings, shared)).items():
        if len(same) > len({run.seed for run in same}):
            _log.warning("%s, %s: a row holds several runs with the same seed.", same[0].scene, method)
        values = {measure: _known(run.scores["ours"][measure] for run in same) for measure in _SCORES}
        if len(values["psnr"]) < len(same):
            _log.warning("%s, %s: runs without a finite PSNR are left out of its mean.", same[0].scene, method)
        for fact in same[0].facts:
            values[fact] = _known(run.facts[fact] for run in same)
        psnr = _mean(values["psnr"])
        first = psnr if not rows else first
        rows.append(Row(same[0].scene, method, tuple(same), values, psnr - first))
    return rows


def _record(row: Row) -> dict[str, Any]:
    """A line of report.csv: plain numbers."""
    record: dict[str, Any] = {"scene": row.scene, "method": row.method, "runs": len(row.runs), "seeds": row.seeds}
    for quantity in _QUANTITIES:
        values = row.values.get(quantity, ())
        record[quantity] = _mean(values)
        record[f"{quantity}_std"] = statistics.stdev(values) if len(values) > 1 else math.nan
        if quantity == "psnr":
            record["psnr_best"] = max(values, default=math.nan)
            record["psnr_delta"] = math.nan if row.delta is None else row.delta
    return record


def _compare(path: Path, scene: str, runs: Mapping[str, Run]) -> None:
    """A test view that all runs rendered, side by side."""
    names = [{file.name for file in (run.folder / "renders").glob("*.png")} for run in runs.values()]
    shared = sorted(set.intersection(*names))
    if not shared:
        _log.warning("%s: no render is common to all runs; there is no comparison picture.", scene)
        return
    view = shared[len(shared) // 2]
    try:
        tiles = {method: np.asarray(read_image(run.folder / "renders" / view)) for method, run in runs.items()}
    except DataError as error:
        _log.warning("%s; there is no comparison picture.", error)
        return
    if len({tile.shape for tile in tiles.values()}) > 1:
        _log.warning("%s: the runs rendered at different sizes; there is no comparison picture.", scene)
        return
    captions = {method: f"mean of its views: {run.scores['ours']['psnr']:.2f} dB" for method, run in runs.items()}
    pictures.comparison(path, tiles, captions, f"{scene} · {Path(view).stem}")


def _history(folder: Path) -> list[dict[str, float]]:
    try:
        with (folder / "history.csv").open(newline="", encoding="utf-8") as file:
            return [{key: float(cell) for key, cell in row.items() if cell} for row in csv.DictReader(file)]
    except (OSError, ValueError, TypeError, csv.Error) as error:
        _log.warning("%s: its history cannot be drawn (%s).", folder, error)
        return []


def _overrides(folder: Path) -> tuple[str, ...]:
    """What the run was started with, as Hydra keeps it; empty where it does not."""
    import yaml  # comes with Hydra

    path = folder / ".hydra" / "overrides.yaml"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else []
    except (OSError, ValueError, yaml.YAMLError) as error:
        problem = f"cannot be read ({str(error)[:120]})"
        raise DataError(path, "overrides", problem, "remove it: the run is then named by its strategies") from error
    return tuple(map(str, content)) if isinstance(content, list) else ()


def _strategies(overrides: Sequence[str], names: Sequence[str]) -> str:
    asked: list[str] = []
    for o in overrides:
        if o.startswith(_METHOD):  # takes the place of what was named before it
            asked = [o.removeprefix(_METHOD)]
        elif o.startswith(_STRATEGY):
            asked.append(o.removeprefix(_STRATEGY).strip("[]").replace(",", " + "))
    return " + ".join(asked or names) or "baseline"


def _name(head: str, settings: Sequence[str], shared: Sequence[str]) -> str:
    return ", ".join((head, *(s for s in settings if s not in shared)))


def _shared(runs: Sequence[Run]) -> list[str]:
    """The settings that all runs have."""
    return [setting for setting in runs[0].settings if all(setting in run.settings for run in runs)]


def _grouped(runs: Iterable[Run], key: Callable[[Run], str]) -> dict[str, list[Run]]:
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return groups


def _sorted(paths: Iterable[Path]) -> list[Path]:
    """By name, numbers by value: Hydra calls the jobs of a sweep 0, 1, … 10."""

    def key(path: Path) -> list[tuple[int, int, str]]:
        words = re.split(r"(\d+)", str(path))
        return [(1, int(word), "") if word.isdecimal() else (0, 0, word) for word in words]

    return sorted(set(paths), key=key)


def _number(value: Any) -> float:
    """JSON has null for what was not finite."""
    return math.nan if value is None else float(value)


def _known(values: Iterable[float]) -> list[float]:
    return [value for value in values if not math.isnan(value)]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _spread(values: Sequence[float], form: str) -> str:
    if not values:
        return ""
    mean = format(_mean(values), form)
    return mean if len(values) == 1 else f"{mean} ± {statistics.stdev(values):{form.lstrip('+')}}"


def aligned(columns: Mapping[str, Sequence[str]]) -> list[str]:
    """A Markdown table that is also one in a terminal."""
    escaped = [[cell.replace("|", "\\|") for cell in (name, *cells)] for name, cells in columns.items()]
    widths = [max(map(len, cells)) for cells in escaped]
    lines = [
        "| " + " | ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)) + " |"
        for cells in zip(*escaped, strict=True)
    ]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]


if __name__ == "__main__":
    sys.exit(main())
