"""A finished run as a report reads it: name, settings, scores, history and skipped work."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd

from clear_strategies.data.view_names import file_stem
from clear_strategies.errors import DataError
from clear_strategies.outputs import metrics
from clear_strategies.outputs.plan import Chosen
from clear_strategies.settings import CHANGES_NO_RESULT

_log = logging.getLogger(__name__)

SCORES: Final = ("psnr", "ssim", "gmsd", "blur")
FACTS: Final = ("conflict", "gaussians", "seconds")
BASELINES: Final = ("bicubic", "prior")

_HYDRA: Final = ".hydra"
_SEED: Final = "fit.seed="
# The overrides that name a run; the others are its settings.
_METHOD, _STRATEGY = "method=", "strategy="
# Where the photos lie: the scene has a name.
_PATH: Final = re.compile(r"scene|data\.root|data\.(reader\.)?path")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A finished run.

    Args:
        scene: its name, followed by the marks in parentheses.
        marks: that the prior is synthetic, that the scores are of training views, that they are against LR photos.
        name: method or strategies as given on the command line ("clear"), else as they are named in the run ("gco + p2g").
        settings: the other overrides, without the seed and those that change no result.
        scores: image ("ours", "bicubic", "prior") -> score -> mean over the test views; over the training views where
            there are no test views.
        views: view -> PSNR of ours, dB, by the names of the files in renders/.
        facts: the numbers in `FACTS`; NaN where unknown.
        config: the configuration, flat, without what changes no result.
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
    config: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path) -> Run:
        """Read a run's folder.

        Raises:
            DataError: metrics.json is damaged.
        """
        path = folder / "metrics.json"
        content = metrics.read(path, "train the run again")
        overrides = content.overrides or []
        part = content.shown
        marks = ["synthetic prior"] * content.synthetic_prior
        marks += [] if part is content.test else ["training views"]
        marks += [f"against {part.against}"] if "LR" in part.against else []
        images = ("ours", *(image for image in BASELINES if image in part.mean))
        try:
            return cls(
                folder=folder,
                scene=content.scene + (f" ({', '.join(marks)})" if marks else ""),
                marks=", ".join(marks),
                name=Chosen(None, content.strategies, overrides).title,
                settings=tuple(filter(_is_setting, overrides)),
                seed=content.seed,
                iterations=content.iterations,
                scores={image: asdict(part.mean[image].numbers) for image in images},
                views={file_stem(view): metrics.as_float(scores["ours"].psnr) for view, scores in part.views.items()},
                facts={
                    "conflict": metrics.as_float(content.conflict.get("gaussian")),
                    "gaussians": content.gaussians,
                    "seconds": content.seconds,
                },
                config=content.config,
            )
        except KeyError as error:
            raise DataError(path, str(error), "is missing", "train the run again") from error


def collect(folders: Iterable[Path]) -> list[Run]:
    """Every finished run at or below the folders and the links in them: the jobs of a sweep by number, other runs by path.
    Unfinished and damaged runs are logged and left out.

    Raises:
        DataError: there is no finished run.
    """
    folders = list(folders)
    folders += [link for folder in folders for link in _sorted(folder.glob("*")) if link.is_symlink() and link.is_dir()]
    finished: dict[Path, None] = {}
    for folder in folders:
        in_folder = _sorted(path.parent for path in folder.rglob("metrics.json"))
        sweeps = [run.parent for run in in_folder]
        in_order = sorted(in_folder, key=lambda run: (sweeps.index(run.parent), _job(run), in_folder.index(run)))
        finished |= dict.fromkeys(run.resolve() for run in in_order)
    for unfinished in _sorted(path.parent for folder in folders for path in folder.rglob(_HYDRA)):
        if unfinished.resolve() not in finished:
            _log.warning("%s: left out, it has no metrics.json: the run did not finish.", unfinished)
    runs = []
    for folder in finished:
        try:
            runs.append(Run.read(folder))
        except DataError as error:
            _log.warning("%s; left out.", error)
    if not runs:
        names = ", ".join(map(str, folders))
        raise DataError(names, "runs", "there is no finished run here", "give the folder of a run or of a sweep")
    return runs


def history(folder: Path) -> list[dict[str, float]]:
    """history.csv, one row per iteration; empty, with a warning, where it cannot be read."""
    try:
        table = pd.read_csv(folder / "history.csv", dtype=float)
    except (OSError, ValueError) as error:
        _log.warning("%s: its history cannot be drawn (%s).", folder, error)
        return []
    return [{name: x for name, x in row.items() if not math.isnan(x)} for row in table.to_dict("records")]


def _is_setting(override: str) -> bool:
    override = override.lstrip("+~")
    key = override.partition("=")[0]
    named_elsewhere = override.startswith((_SEED, _METHOD, _STRATEGY)) or _PATH.fullmatch(key)
    return not (named_elsewhere or key.startswith("hydra") or key in CHANGES_NO_RESULT)


def _sorted(paths: Iterable[Path]) -> list[Path]:
    """Sort by path, numbers by value: the folders of a sweep are 0, 1, … 10."""

    def key(path: Path) -> list[tuple[int, int, str]]:
        words = re.split(r"(\d+)", str(path))
        return [(1, int(word), "") if word.isdecimal() else (0, 0, word) for word in words]

    return sorted(set(paths), key=key)


def _job(folder: Path) -> int:
    """The run's number in its sweep; 0 for a single run, which then sorts by path."""
    try:
        content = (folder / _HYDRA / "hydra.yaml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return 0
    number = re.search(r"^    num: (\d+)$", content, re.MULTILINE)
    return int(number[1]) if number else 0
