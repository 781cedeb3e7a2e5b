"""`python -m clear_strategies.report DIR …`: a run or a sweep as one table (Markdown, CSV) and pictures.

Every folder below DIR with a metrics.json is a run. Runs that differ in nothing but their seed share a row: mean ±
standard deviation, the best beside it. Baselines that any scene has (bicubic, the prior alone) stand once a scene.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import math
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from clear_strategies import files, pictures
from clear_strategies.data.photo_files import read_image
from clear_strategies.errors import ClearError, DataError
from clear_strategies.metrics import NOTE

_log = logging.getLogger(__name__)

_SCORES: Final = ("psnr", "ssim", "gmsd", "blur")
_FORMATS: Final = (("ssim", ".4f"), ("gmsd", ".4f"), ("blur", "+.4f"))
_HEADER: Final = (
    "scene", "method", "PSNR (dB) ↑", "Δ", "best", "SSIM ↑", "GMSD ↓", "blur → 0", "conflict", "Gaussians", "seconds", "runs",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A finished run: its folder, the content of metrics.json, and the overrides it was started with."""

    folder: Path
    metrics: dict[str, Any]
    overrides: tuple[str, ...]

    @property
    def scene(self) -> str:
        return str(self.metrics["scene"]) + (" (synthetic prior)" if self.metrics.get("synthetic_prior") else "")

    @property
    def method(self) -> str:
        """Strategies, and whatever else was overridden but the seed."""
        strategies = " + ".join(self.metrics["strategies"]) or "baseline"
        quiet = ("+strategy", "fit.seed", "hydra.", "data.path", "data=", "prior.path", "prior=")
        others = [o for o in self.overrides if not o.startswith(quiet)]
        return ", ".join((strategies, *others))

    def score(self, name: str, method: str = "ours") -> float:
        part = self.metrics["test"] if self.metrics["test"]["mean"] else self.metrics["train"]
        value = part["mean"].get(method, {}).get(name)
        return math.nan if value is None else float(value)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m clear_strategies.report", description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="a run's folder, or a folder of runs")
    parser.add_argument("--out", type=Path, help="where the report goes (default: the first DIR)")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        runs = collect(options.folders)
        sys.stdout.write(write(runs, options.out or options.folders[0]) + "\n")
    except ClearError as error:
        _log.error("%s", error)
        return 2
    return 0


def collect(folders: Sequence[Path]) -> list[Run]:
    """Every readable run below the folders, in order of their paths; what is broken is named and left out.

    Raises:
        DataError: there is none.
    """
    runs = []
    for folder in folders:
        for path in sorted(folder.rglob("metrics.json")):
            try:
                metrics = json.loads(path.read_text())
                run = Run(path.parent, metrics, _overrides(path.parent))
                (run.scene, run.method, metrics["gaussians"], metrics["seconds"], metrics["seed"])
                run.score("psnr")
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                _log.warning("%s: left out, it is no metrics.json of a finished run (%s).", path, error)
                continue
            runs.append(run)
    if not runs:
        raise DataError(
            folders[0], "runs", "no folder here has a metrics.json", "give the folder of a finished run or sweep"
        )
    return runs


def write(runs: Sequence[Run], out: Path) -> str:
    """report.md, report.csv, comparison and curves pictures into `out`; returns the Markdown table."""
    rows = table(runs)
    markdown = "\n".join(_markdown(_HEADER, rows))
    legend = "Δ: to the first method of the scene. Spread: standard deviation over seeds."
    files.write_text(out / "report.md", f"{markdown}\n\n{NOTE[0].upper()}{NOTE[1:]}. {legend}\n")
    files.write_csv(out / "report.csv", [dict(zip(_HEADER, row, strict=True)) for row in rows], _HEADER)
    for scene in dict.fromkeys(run.scene for run in runs):
        of_scene = {run.method: run for run in runs if run.scene == scene}
        name = "".join(c if c.isalnum() else "_" for c in scene).strip("_")
        _compare(out / f"comparison_{name}.png", scene, of_scene)
        pictures.overlay(out / f"curves_{name}.png", {m: _history(run.folder) for m, run in of_scene.items()}, scene)
    _log.info("report of %d runs: %s", len(runs), out)
    return markdown


def table(runs: Sequence[Run]) -> list[list[str]]:
    """One row per scene and method, the scene's baselines first."""
    rows = []
    for scene in dict.fromkeys(run.scene for run in runs):
        of_scene = [run for run in runs if run.scene == scene]
        for method in ("bicubic", "prior"):
            psnr, ssim, gmsd, blur = (_mean([run.score(s, method) for run in of_scene]) for s in _SCORES)
            if not math.isnan(psnr):
                rows.append(
                    [scene, method, f"{psnr:.2f}", "", "", f"{ssim:.4f}", f"{gmsd:.4f}", f"{blur:+.4f}", *[""] * 4]
                )
        first = math.nan
        for method in dict.fromkeys(run.method for run in of_scene):
            same = [run for run in of_scene if run.method == method]
            scores = [run.score("psnr") for run in same]
            mean = _mean(scores)
            first = mean if math.isnan(first) else first
            rows.append(
                [
                    scene, method, _spread(scores, ".2f"), f"{mean - first:+.2f}", f"{max(scores):.2f}" if len(same) > 1 else "",
                    *(_spread([run.score(s) for run in same], f) for s, f in _FORMATS),
                    _spread([_conflict(run) for run in same], ".3f"), f"{_mean([run.metrics['gaussians'] for run in same]):,.0f}",
                    f"{_mean([run.metrics['seconds'] for run in same]):.0f}", str(len(same)),
                ]
            )  # fmt: skip
    return rows


def _compare(path: Path, scene: str, runs: dict[str, Run]) -> None:
    """The first test view that all runs have, side by side."""
    names = [{p.name for p in (run.folder / "renders").glob("*.png")} for run in runs.values()]
    shared = sorted(set.intersection(*names)) if names else []
    if not shared:
        _log.warning("%s: no render is common to all runs; no comparison picture.", scene)
        return
    middle = shared[len(shared) // 2]
    tiles = {method: np.asarray(read_image(run.folder / "renders" / middle)) for method, run in runs.items()}
    if len({tile.shape for tile in tiles.values()}) > 1:
        _log.warning("%s: the runs rendered at different sizes; no comparison picture.", scene)
        return
    captions = {method: f"mean {run.score('psnr'):.2f} dB" for method, run in runs.items()}
    pictures.comparison(path, tiles, captions, f"{scene} · {Path(middle).stem}")


def _history(folder: Path) -> list[dict[str, float]]:
    try:
        with (folder / "history.csv").open(newline="") as file:
            return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]
    except (OSError, ValueError) as error:
        _log.warning("%s: its history cannot be drawn (%s).", folder, error)
        return []


def _overrides(folder: Path) -> tuple[str, ...]:
    import yaml  # Hydra's own dependency

    path = folder / ".hydra" / "overrides.yaml"
    if not path.is_file():
        return ()
    try:
        content = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{path.name} is no YAML: {error}") from error
    return tuple(map(str, content or ()))


def _conflict(run: Run) -> float:
    value = run.metrics.get("conflict", {}).get("gaussian")
    return math.nan if value is None else float(value)


def _mean(values: Sequence[float]) -> float:
    known = [v for v in values if not math.isnan(v)]
    return sum(known) / len(known) if known else math.nan


def _spread(values: Sequence[float], form: str) -> str:
    known = [v for v in values if not math.isnan(v)]
    if not known:
        return ""
    mean = format(sum(known) / len(known), form)
    return mean if len(known) == 1 else f"{mean} ± {statistics.stdev(known):{form.lstrip('+')}}"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(str(row[i])) for row in (header, *rows)) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)) + " |"

    return [line(header), "|" + "|".join("-" * (width + 2) for width in widths) + "|", *map(line, rows)]


if __name__ == "__main__":
    sys.exit(main())
