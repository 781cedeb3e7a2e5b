"""Finished runs as reports read them: name, settings, scores and history."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import msgspec
import pandas as pd

from clear_strategies.data.photo_files import read_header
from clear_strategies.data.view_names import file_stems
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
        views: the names of the scored views. size: "WIDTHxHEIGHT", px, at which the first of them with a picture is scored;
            empty: unknown. config: every setting, by its dotted key.
        job: its number in a sweep, None without one; ended: when, UTC, empty if unknown; keys: of all overrides that may change a
            result, but of methods and strategies, which take each other's place; the jobs of a sweep share them.
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
    size: str
    config: Mapping[str, Any]
    job: int | None
    ended: str
    keys: frozenset[str]

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
        given, hydra = {key_of(word): word for word in overrides}, _hydra(folder)
        chosen = dict(re.findall(r"^      (protocol|scene): (\w+)$", hydra, re.MULTILINE))
        job = re.search(r"^    num: (\d+)$", hydra, re.MULTILINE)
        return cls(
            folder=folder,
            scene=content.scene + (f" ({', '.join(marks)})" if marks else ""),
            marks=", ".join(marks),
            name=Chosen(content.method, content.strategies, overrides).title,
            protocol=chosen.get("scene") or chosen.get("protocol"),
            settings=tuple(filter(_is_setting, given.values())),
            seed=content.seed,
            numbers={
                **ours,
                **own,
                **{image: psnr.get(image, math.nan) for image in ("bicubic", "prior")},
                "conflict": content.conflict.get("gaussian", math.nan),
                "gaussians": content.gaussians,
                "seconds": content.seconds,
            },
            views=(views := tuple(sorted(part.views))),
            size=_size_of(folder, views, "lr" if part.against_lr else "truth"),
            config=content.config,
            job=int(job[1]) if job else None,
            ended=str(content.provenance.get("date", "")),
            keys=frozenset(key for key in given if not OF_STRATEGY.fullmatch(key))
            - CHANGES_NO_RESULT
            - {"method", "strategy"},
        )


def collect(folders: Iterable[Path]) -> list[FinishedRun]:
    """Read every finished run at or below the folders and the links in them: sweep by sweep, their jobs by number, other runs by
    path. Unfinished and damaged runs are left out with a warning.
    """
    folders = list(folders)
    folders += [link for folder in folders for link in sorted(folder.glob("*")) if link.is_symlink() and link.is_dir()]
    seen, runs = set[Path](), list[FinishedRun]()
    for folder in folders:
        in_folder = list[FinishedRun]()
        if not folder.is_dir():
            _log.warning("%s: is not there, or is a file.", folder)
        for path in sorted(folder.rglob(FINISHED)):
            if (run := path.parent.resolve()) in seen:
                continue
            seen.add(run)
            try:
                in_folder.append(FinishedRun.read(run))
            except DataError as error:
                _log.warning("%s; left out.", error)
        runs += _in_order(in_folder)
    for unfinished in sorted({path.parent for folder in folders for path in folder.rglob(_HYDRA)}):
        if unfinished.resolve() not in seen:
            _log.warning("%s: left out, it has no metrics.json: the run did not finish.", unfinished)
    if not runs:
        names = ", ".join(map(str, folders))
        raise DataError(names, "runs", "there is no finished run here", "give the folder of a run or of a sweep")
    return _with_settings_of_files(_with_distinct_scenes(runs))


def _with_distinct_scenes(runs: Sequence[FinishedRun]) -> list[FinishedRun]:
    """Rename scenes of the same name that are not the same, since their photos, scored views or sizes differ."""
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
        same = [other for other in of if photos[other] == photos[run]]
        if len({other.views for other in same}) > 1:
            some = ", ".join(run.views[:3]) + (", …" if len(run.views) > 3 else "")
            scene = f"{scene}, {counted(len(run.views), 'view')}: {some}"
        if len({other.size for other in same if other.views == run.views} - {""}) > 1:
            scene = f"{scene}, scored at {run.size or 'an unknown size'}"
        apart.append(replace(run, scene=scene))
    for scene in dict.fromkeys(run.scene for run, other in zip(runs, apart, strict=True) if run.scene != other.scene):
        _log.warning("%s: runs of other photos, or scored on other views or at other sizes, are not compared.", scene)
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


def _in_order(runs: Sequence[FinishedRun]) -> list[FinishedRun]:
    """Folder by folder: in each the runs without a sweep, then its sweeps by the end of their first jobs, their jobs by number.
    The jobs of a sweep have the same keys; of two with the same number, the later one begins another sweep.
    """
    sweeps, latest = list[dict[int, FinishedRun]](), dict[Any, dict[int, FinishedRun]]()
    for run in sorted(runs, key=lambda run: ("", 0) if run.job is None else (run.ended, run.job)):
        sweep, job = (run.folder, 0) if run.job is None else ((run.folder.parent, run.keys), run.job)
        if job in latest.get(sweep, {job: run}):
            latest[sweep] = {}
            sweeps.append(latest[sweep])
        latest[sweep][job] = run
    parents = [run.folder.parent for run in runs]
    in_sweeps = [sweep[job] for sweep in sweeps for job in sorted(sweep)]
    return sorted(in_sweeps, key=lambda run: parents.index(run.folder.parent))


def _size_of(folder: Path, views: Iterable[str], kind: str) -> str:
    """The size of the first picture of this kind that the run has kept of these views; empty if there is none."""
    pictures = (folder / "views" / f"{stem}_{kind}.png" for stem in file_stems(views).values())
    with suppress(DataError, StopIteration):
        width, height = read_header(next(filter(Path.is_file, pictures))).stored
        return f"{width}x{height}"
    return ""


def _hydra(folder: Path) -> str:
    """The text of Hydra's own file of a run; empty if it cannot be read."""
    try:
        return (folder / _HYDRA / "hydra.yaml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""
