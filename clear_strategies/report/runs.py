"""A finished run as a report reads it: its name, its scores, its history and what it skipped."""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

SCORES: Final = ("psnr", "ssim", "gmsd", "blur")
BASELINES: Final = ("bicubic", "prior")

_SEED: Final = "fit.seed="
# What names a run; the rest of the overrides are its settings.
_METHOD, _STRATEGY = "method=", "strategy="
# Overrides that change no result, and paths: what a scene is, its name says.
_NEUTRAL: Final = (
    "hydra", "fit.resume=", "fit.threads=", "fit.keep=", "fit.checkpoint_every=", "fit.probe_", "fit.map_views=", "scene=",
    "data.root=",
)  # fmt: skip
_PATH: Final = re.compile(r"data\.[\w.]*path=")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A finished run.

    Args:
        scene: its name, with its marks.
        marks: said where the prior is synthetic or the scores are not those of HR.
        name: method or strategies as they were asked for ("clear"), else as metrics.json lists them ("gco + p2g").
        settings: Hydra's overrides but for seed and name, without what changes no result.
        scores: method ("ours", "bicubic", "prior") -> measure -> mean over the test views; over the training views
            where there are no test views.
        views: view -> PSNR of ours, dB; the views are named as their pictures are.
        facts: "conflict", "gaussians", "seconds"; NaN where unknown.
        plan: label -> fact about the input, as the run printed it.
    """

    folder: Path
    scene: str
    marks: str
    name: str
    settings: tuple[str, ...]
    seed: int
    iterations: int
    scores: Mapping[str, Mapping[str, float]]
    views: Mapping[str, float]
    facts: Mapping[str, float]
    plan: Mapping[str, str]

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
            methods = ("ours", *(baseline for baseline in BASELINES if baseline in part["mean"]))
            return cls(
                folder=folder,
                scene=str(content["scene"]) + (f" ({', '.join(marks)})" if marks else ""),
                marks=", ".join(marks),
                name=_name(overrides, content["strategies"]),
                settings=tuple(o for o in overrides if _is_setting(o)),
                seed=int(content["seed"]),
                iterations=int(content["iterations"]),
                scores={m: {s: _number(part["mean"][m][s]) for s in SCORES} for m in methods},
                views={Path(view).stem: _number(of["ours"]["psnr"]) for view, of in part["views"].items()},
                facts={
                    "conflict": _number(content["conflict"].get("gaussian")),
                    "gaussians": _number(content["gaussians"]),
                    "seconds": _number(content["seconds"]),
                },
                plan={str(k): str(v) for k, v in content["provenance"].get("plan", {}).items()},
            )
        except KeyError as error:
            raise DataError(path, str(error), "is missing", "train the run again") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise DataError(path, "content", f"is not what a run leaves ({error})", "train the run again") from error


def collect(folders: Iterable[Path]) -> list[Run]:
    """Every finished run at or below the folders, a sweep's in the order in which it was asked for, others by path; what is
    unfinished or damaged is named and left out.

    Raises:
        DataError: there is none.
    """
    folders = list(folders)
    found: dict[Path, None] = {}
    for folder in folders:
        runs_here = _sorted(path.parent for path in folder.rglob("metrics.json"))
        sweeps = list(dict.fromkeys(run.parent for run in runs_here))
        for run in sorted(runs_here, key=lambda run: (sweeps.index(run.parent), _job(run))):
            found[run.resolve()] = None
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


def history(folder: Path) -> list[dict[str, float]]:
    """One row an iteration; empty, and said so, where it cannot be read."""
    try:
        with (folder / "history.csv").open(newline="", encoding="utf-8") as file:
            return [{key: float(cell) for key, cell in row.items() if cell} for row in csv.DictReader(file)]
    except (OSError, ValueError, TypeError, csv.Error) as error:
        _log.warning("%s: its history cannot be drawn (%s).", folder, error)
        return []


def skips(folder: Path) -> list[dict[str, str]]:
    """The lines of timing.csv that say what was skipped and why; empty where there is no such table."""
    try:
        with (folder / "timing.csv").open(newline="", encoding="utf-8") as file:
            return [row for row in csv.DictReader(file) if row.get("why")]
    except (OSError, ValueError, csv.Error) as error:
        _log.info("%s: what it skipped is not known (%s).", folder, error)
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


def _is_setting(override: str) -> bool:
    key = override.lstrip("+~")
    return not (key.startswith((*_NEUTRAL, _SEED, _METHOD, _STRATEGY)) or _PATH.match(key))


def _name(overrides: Sequence[str], strategies: Sequence[str]) -> str:
    asked: list[str] = []
    for override in overrides:
        key, value = override.lstrip("+"), override.partition("=")[2].strip("[]").replace(",", " + ")
        if key.startswith(_METHOD):  # takes the place of what was named before it
            asked = [value]
        elif key.startswith(_STRATEGY):
            asked.append(value)
    return " + ".join(asked or strategies) or "baseline"


def _sorted(paths: Iterable[Path]) -> list[Path]:
    """By name, numbers by value: Hydra calls the jobs of a sweep 0, 1, … 10."""

    def key(path: Path) -> list[tuple[int, int, str]]:
        words = re.split(r"(\d+)", str(path))
        return [(1, int(word), "") if word.isdecimal() else (0, 0, word) for word in words]

    return sorted(set(paths), key=key)


def _job(folder: Path) -> int:
    """Its number in the sweep that it was a job of; 0 where it was of none, which leaves its place to its name."""
    try:
        content = (folder / ".hydra" / "hydra.yaml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return 0
    number = re.search(r"^    num: (\d+)$", content, re.MULTILINE)
    return int(number[1]) if number else 0


def _number(value: Any) -> float:
    """JSON has null for what was not finite."""
    return math.nan if value is None else float(value)
