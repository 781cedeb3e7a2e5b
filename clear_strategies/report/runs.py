"""Finished runs as reports read them: name, settings, scores and history."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import msgspec
import pandas as pd

from clear_strategies.errors import DataError, counted
from clear_strategies.files import FINISHED
from clear_strategies.outputs import metrics
from clear_strategies.outputs.plan import OF_STRATEGY, Chosen
from clear_strategies.settings import CHANGES_NO_RESULT, key_of
from clear_strategies.viewing.cameras import FILE as CAMERAS

_log = logging.getLogger(__name__)

OWN: Final = "metrics."
"""Prefix of the names of a run's own metrics."""
_HYDRA: Final = ".hydra"
# The keys of a run's seed and name; other overrides are its settings.
_COLUMNS: Final = ("fit.seed", "method", "strategy")
_DATA: Final = ("data.path", "data.root")  # keys of a run's configuration
# Suffixes of keys that never distinguish runs: seeds, and paths, whose content may have moved.
_OF_SEED_OR_PLACE: Final = ("seed", "path", "root", "cache", "lr_folder")
# Keys of the photos' place, which is not a setting, since the scene has a name.
_PATH: Final = re.compile(r"scene|data\.root|data\.(reader\.)?path")


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """A finished run.

    Args:
        scene: its name, followed by the marks in parentheses; see `_with_distinct_scenes`.
        marks: notes that the prior is synthetic, that scores are of training views, or that they are against LR photos.
        name: method or strategies as given on the command line ("clear"), else as they are named in the run ("gco + p2g").
        protocol: its option of conf/protocol or conf/scene; None: it has none.
        settings: the other overrides, without the seed and those that change no result; and settings of files, see
            `_with_settings_of_files`.
        numbers: mean scores of the test views, or of the training views if there are no test views, those of the run's own
            metrics as "metrics.<name>"; "bicubic", "prior": PSNR of these images; conflict, gaussians, seconds. NaN: unknown.
        views: the names of the scored views. config: every setting, by its dotted key.
    """

    folder: Path
    scene: str
    marks: str
    name: str
    protocol: str | None
    settings: tuple[str, ...]
    seed: int
    numbers: Mapping[str, float]
    views: tuple[str, ...]
    config: Mapping[str, Any]

    @property
    def data(self) -> str:
        """The folder of the photos."""
        return str(next((self.config[key] for key in _DATA if self.config.get(key)), ""))

    @classmethod
    def read(cls, folder: Path) -> FinishedRun:
        path = folder / FINISHED
        content = metrics.read(path, "train the run again")
        overrides, part = content.overrides or [], content.shown
        if "ours" not in part.mean:
            raise DataError(path, "ours", "is missing", "train the run again")
        marks = ["synthetic prior"] * content.synthetic_prior
        marks += [] if part is content.test else ["training views"]
        marks += [f"against {part.against}"] if part.against_lr else []
        psnr = {image: scores.psnr for image, scores in part.mean.items()}
        ours = msgspec.structs.asdict(part.mean["ours"])
        own = {f"{OWN}{name}": x for name, x in ours.pop("own").items()}
        return cls(
            folder=folder,
            scene=content.scene + (f" ({', '.join(marks)})" if marks else ""),
            marks=", ".join(marks),
            name=Chosen(content.method, content.strategies, overrides).title,
            protocol=_protocol(folder),
            settings=tuple(filter(_is_setting, {key_of(word): word for word in overrides}.values())),
            seed=content.seed,
            numbers={
                **ours,
                **own,
                **{image: psnr.get(image, math.nan) for image in ("bicubic", "prior")},
                "conflict": content.conflict.get("gaussian", math.nan),
                "gaussians": content.gaussians,
                "seconds": content.seconds,
            },
            views=tuple(sorted(part.views)),
            config=content.config,
        )


def collect(folders: Iterable[Path]) -> list[FinishedRun]:
    """Read every finished run at or below the folders and the links in them: sweep by sweep, their jobs by number, other runs by
    path. Unfinished and damaged runs are left out with a warning.
    """
    folders = list(folders)
    folders += [link for folder in folders for link in sorted(folder.glob("*")) if link.is_symlink() and link.is_dir()]
    finished: dict[Path, None] = {}
    for folder in folders:
        in_folder = sorted(path.parent for path in folder.rglob(FINISHED))
        sweeps = [run.parent for run in in_folder]
        places = _places(in_folder)
        in_order = sorted(in_folder, key=lambda run: (sweeps.index(run.parent), places[run], in_folder.index(run)))
        finished |= dict.fromkeys(run.resolve() for run in in_order)
    for unfinished in sorted({path.parent for folder in folders for path in folder.rglob(_HYDRA)}):
        if unfinished.resolve() not in finished:
            _log.warning("%s: left out, it has no metrics.json: the run did not finish.", unfinished)
    runs = []
    for folder in finished:
        try:
            runs.append(FinishedRun.read(folder))
        except DataError as error:
            _log.warning("%s; left out.", error)
    if not runs:
        names = ", ".join(map(str, folders))
        raise DataError(names, "runs", "there is no finished run here", "give the folder of a run or of a sweep")
    return _with_settings_of_files(_with_distinct_scenes(runs))


def _with_distinct_scenes(runs: Sequence[FinishedRun]) -> list[FinishedRun]:
    """Rename scenes of the same name that are not the same, since their photos or their scored views differ."""
    cameras = {
        run: file.read_text(encoding="utf-8") if (file := run.folder / CAMERAS).is_file() else str(file) for run in runs
    }
    alike = {run: [other for other in runs if other.scene == run.scene] for run in runs}
    # The folder of the photos; runs with the same cameras have the same photos.
    photos = {
        run: next(other.data for other in of if other.data == run.data or cameras[other] == cameras[run])
        for run, of in alike.items()
    }
    apart = []
    for run, of in alike.items():
        scene = run.scene
        if len(places := {photos[other] for other in of}) > 1:
            scene = f"{scene} of {_shortest(photos[run], places)}"
        if len({other.views for other in of if photos[other] == photos[run]}) > 1:
            some = ", ".join(run.views[:3]) + (", …" if len(run.views) > 3 else "")
            scene = f"{scene}, {counted(len(run.views), 'view')}: {some}"
        apart.append(replace(run, scene=scene))
    for scene in dict.fromkeys(run.scene for run, other in zip(runs, apart, strict=True) if run.scene != other.scene):
        _log.warning("%s: runs of other photos, or scored on other views, are not compared.", scene)
    return apart


def _with_settings_of_files(runs: Sequence[FinishedRun]) -> list[FinishedRun]:
    """Add settings of files to runs of the same scene, name and overrides that differ in them: a file, or a default of the
    package, has changed between the runs.
    """
    alike: dict[Any, list[FinishedRun]] = {}
    for run in runs:
        alike.setdefault((run.scene, run.name, frozenset(run.settings)), []).append(run)
    complete = {}
    for of in alike.values():
        known = dict.fromkeys(key for run in of for key in run.config if not key.endswith(_OF_SEED_OR_PLACE))
        differ = [k for k in known if len({str(run.config[k]) for run in of if k in run.config}) > 1]
        for run in of:
            more = (f"{key}={run.config[key]}" for key in differ if key in run.config)
            complete[run] = replace(run, settings=(*run.settings, *more))
    return [complete[run] for run in runs]


def _shortest(path: str, others: Collection[str]) -> str:
    """The shortest end of a path, of two parts or more, that no other one has."""
    parts = Path(path).parts
    ends = ("/".join(parts[-k:]) for k in range(2, len(parts)))
    return next((end for end in ends if sum(other.endswith(end) for other in others) == 1), path)


def history(folder: Path) -> pd.DataFrame:
    """Read history.csv, one row per iteration; empty, with a warning, if it cannot be read."""
    try:
        return pd.read_csv(folder / "history.csv", dtype=float)
    except (OSError, ValueError) as error:
        _log.warning("%s: its history cannot be drawn (%s).", folder, error)
        return pd.DataFrame()


def _is_setting(override: str) -> bool:
    key = key_of(override)
    named_elsewhere = key in _COLUMNS or _PATH.fullmatch(key) or OF_STRATEGY.fullmatch(key)
    return not (named_elsewhere or key.startswith(("hydra", OWN)) or key in CHANGES_NO_RESULT)


def _places(folders: Sequence[Path]) -> dict[Path, tuple[int, int]]:
    """The sweep of each run among those that have its `hydra.sweep.dir`, by the dates of their ends, and its number there; of two
    runs with one number, the later one begins another sweep. 0, 0 for a single run.
    """
    jobs = {run: int(said[1]) for run in folders if (said := re.search(r"^    num: (\d+)$", _hydra(run), re.MULTILINE))}
    places, begun = dict.fromkeys(folders, (0, 0)), dict[Path, list[set[int]]]()
    for run in sorted(jobs, key=lambda run: (_date(run), jobs[run])):
        of_folder = begun.setdefault(run.parent, [set()])
        if jobs[run] in of_folder[-1]:
            of_folder.append(set())
        of_folder[-1].add(jobs[run])
        places[run] = len(of_folder), jobs[run]
    return places


def _date(folder: Path) -> str:
    """When a run finished, UTC; empty if its file cannot be read, which `FinishedRun.read` tells."""
    try:
        return str(metrics.read(folder / FINISHED, "").provenance.get("date", ""))
    except DataError:
        return ""


def _protocol(folder: Path) -> str | None:
    chosen = dict(re.findall(r"^      (protocol|scene): (\w+)$", _hydra(folder), re.MULTILINE))
    return chosen.get("scene") or chosen.get("protocol")


def _hydra(folder: Path) -> str:
    """The text of Hydra's own file of a run; empty if it cannot be read."""
    try:
        return (folder / _HYDRA / "hydra.yaml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""
