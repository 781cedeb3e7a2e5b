"""Which runs share a row of the table, and how far each method is from the first.

Differences are taken seed by seed where two methods share seeds: what a seed does to both methods is then no part of the
error.
"""

from __future__ import annotations

import itertools
import logging
import math
import statistics
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from clear_strategies.report.runs import BASELINES, FACTS, SCORES, Run

_log = logging.getLogger(__name__)

Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)

# Overrides that choose what the baselines see.
_INPUT: Final = ("data", "prior", "experiment", "protocol")
_DECORATORS: Final = "decorators."


@dataclass(frozen=True, slots=True)
class Difference:
    """PSNR of a method minus that of the first, dB.

    Args:
        mean: over the pairs; with fewer than two pairs, the difference of the two means.
        error: standard error of the mean over pairs; NaN with fewer than two pairs.
        pairs: how many seeds (of an average: scenes and seeds) both methods have.
    """

    mean: float
    error: float = math.nan
    pairs: int = 0

    @classmethod
    def paired(cls, values: Sequence[float], first: Sequence[float], differences: Sequence[float]) -> Difference:
        """From the values of a method and of the first, and their differences where they share a seed."""
        if len(differences) < 2:
            return cls(mean(values) - mean(first), pairs=len(differences))
        error = statistics.stdev(differences) / math.sqrt(len(differences))
        return cls(mean(differences), error, len(differences))

    def __str__(self) -> str:
        if math.isnan(self.mean):
            return ""
        return f"{self.mean:+.2f}" + ("" if math.isnan(self.error) else f" ± {self.error:.2f}")


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """A method on a scene, or its average over scenes.

    Args:
        method: the name of the runs, then the settings that not all runs of the scene share.
        name: the name alone.
        runs: they differ in their seed only. Empty for an average over scenes.
        values: quantity -> one number per run (of an average: the mean of each scene); NaN is left out.
        delta: difference from the first method of the scene; None for a baseline.
    """

    scene: str
    method: str
    name: str
    runs: tuple[Run, ...]
    values: Mapping[str, Sequence[float]]
    delta: Difference | None = None

    @property
    def is_baseline(self) -> bool:
        return self.delta is None

    @property
    def is_average(self) -> bool:
        return not self.runs

    @property
    def seeds(self) -> str:
        return "" if self.is_baseline else ", ".join(map(str, sorted({run.seed for run in self.runs})))


def compare(runs: Sequence[Run]) -> list[Row]:
    """For each scene, in the order of the runs, its baselines and one row per method; then the averages over scenes."""
    scenes = _grouped(runs, lambda run: run.scene)
    rows: dict[str, list[Row]] = {}
    for scene, of_scene in scenes.items():
        baselines = [_baseline_rows(of_scene, baseline) for baseline in BASELINES]
        rows[scene] = [*itertools.chain(*baselines), *_method_rows(of_scene)]
    averages = []
    # Scores against LR photos, or of training views, are not averaged with others.
    for marks, alike in _grouped(scenes, lambda scene: scenes[scene][0].marks).items():
        averages += _averages([rows[scene] for scene in alike], marks)
    return [row for of_scene in rows.values() for row in of_scene] + averages


def mean(values: Sequence[float]) -> float:
    """NaN for an empty sequence."""
    return sum(values) / len(values) if values else math.nan


def shared_settings(runs: Sequence[Run]) -> list[str]:
    """The settings that all runs have."""
    return _in_all([run.settings for run in runs])


def _in_all(lists: Sequence[Sequence[str]]) -> list[str]:
    """What every list holds, in the order of the first."""
    return [setting for setting in lists[0] if all(setting in other for other in lists)] if lists else []


def _baseline_rows(runs: Sequence[Run], baseline: str) -> list[Row]:
    """Of one scene: the row of a baseline, or one per input (data, prior) where the runs differ in it."""
    inputs = {run: _inputs(run, baseline) for run in runs if baseline in run.scores}
    shared, rows = _in_all([*inputs.values()]), []
    for same in _grouped(inputs, lambda run: frozenset(inputs[run])).values():
        label = _label(baseline, inputs[same[0]], shared)
        # Runs with the same input have the same baseline, unless the prior depends on the seed.
        values = {m: sorted(set(_known(run.scores[baseline][m] for run in same))) for m in SCORES}
        rows.append(Row(same[0].scene, label, baseline, tuple(same), values))
    return rows


def _method_rows(runs: Sequence[Run]) -> list[Row]:
    """Of one scene: one row per name and set of settings."""
    shared = shared_settings(runs)
    rows: list[Row] = []
    for same in _grouped(runs, lambda run: (run.name, frozenset(run.settings))).values():
        method = _label(same[0].name, same[0].settings, shared)
        if len(same) > len({run.seed for run in same}):
            _log.warning("%s, %s: a row holds several runs with the same seed.", same[0].scene, method)
        values = {measure: _known(run.scores["ours"][measure] for run in same) for measure in SCORES}
        if len(values["psnr"]) < len(same):
            _log.warning("%s, %s: runs without a finite PSNR are left out of its mean.", same[0].scene, method)
        values |= {fact: _known(run.facts[fact] for run in same) for fact in FACTS}
        delta = Difference(0.0)
        if rows:
            pairs = _seed_differences(same, rows[0].runs)
            delta = Difference.paired(values["psnr"], rows[0].values["psnr"], pairs)
        rows.append(Row(same[0].scene, method, same[0].name, tuple(same), values, delta))
    return rows


def _averages(scenes: Sequence[Sequence[Row]], marks: str) -> list[Row]:
    """One row for each method that all of several scenes have."""
    if len(scenes) < 2:
        return []
    title = f"average of {len(scenes)} scenes" + (f" ({marks})" if marks else "")
    tables = [_by_identity(of_scene) for of_scene in scenes]
    common = [identity for identity in tables[0] if all(identity in rows for rows in tables)]
    left_out = [row.method for rows in tables for identity, row in rows.items() if identity not in common]
    if left_out:
        _log.info("%s: left out, because not all scenes have it: %s.", title, "; ".join(dict.fromkeys(left_out)))
    methods = [settings for name, settings in common if name not in BASELINES]
    shared = _in_all(methods)
    averages: list[Row] = []
    first: list[Row] = []  # the first method on each scene
    for identity in common:
        rows = [of_scene[identity] for of_scene in tables]
        measured = [q for q in rows[0].values if all(row.values.get(q) for row in rows)]
        values = {q: [mean(row.values[q]) for row in rows] for q in measured}
        delta = None
        if not rows[0].is_baseline:
            first = first or rows
            pairs = [d for row, base in zip(rows, first, strict=True) for d in _seed_differences(row.runs, base.runs)]
            psnr = [mean(row.values["psnr"]) for row in first]
            delta = Difference(0.0) if rows is first else Difference.paired(values.get("psnr", ()), psnr, pairs)
        averages.append(Row(title, _label(*identity, shared), rows[0].name, (), values, delta))
    return averages


def _by_identity(rows: Sequence[Row]) -> dict[tuple[str, tuple[str, ...]], Row]:
    """The rows of one scene by name and settings, without the `data` settings that all of its runs share: those describe
    the scene.
    """
    shared = [s for s in shared_settings([run for row in rows for run in row.runs]) if _is_input(s, ("data",))]
    by_identity = {}
    for row in rows:
        settings = _inputs(row.runs[0], row.name) if row.is_baseline else row.runs[0].settings
        by_identity[row.name, tuple(sorted(s for s in settings if s not in shared))] = row
    return by_identity


def _inputs(run: Run, baseline: str) -> list[str]:
    """What the images of a baseline depend on: the settings of data and prior; for the SR images also their decorators,
    which a strategy may bring.
    """
    inputs = [s for s in run.settings if _is_input(s)]
    if baseline != "prior":
        return inputs
    decorators = {key.split(".")[1] for key in run.config if key.startswith(_DECORATORS)}
    return [*inputs, *sorted(decorators), *(s for s in run.settings if _is_input(s, (_DECORATORS,)))]


def _is_input(setting: str, groups: tuple[str, ...] = _INPUT) -> bool:
    return setting.lstrip("+~").startswith(groups)


def _seed_differences(runs: Sequence[Run], first: Sequence[Run]) -> list[float]:
    """PSNR minus that of the first method, for each seed that both have."""
    psnr, base = _psnr_by_seed(runs), _psnr_by_seed(first)
    return [psnr[seed] - base[seed] for seed in psnr if seed in base]


def _psnr_by_seed(runs: Sequence[Run]) -> dict[int, float]:
    by_seed = _grouped(runs, lambda run: run.seed)
    values = {seed: _known(run.scores["ours"]["psnr"] for run in same) for seed, same in by_seed.items()}
    return {seed: mean(psnr) for seed, psnr in values.items() if psnr}


def _label(name: str, settings: Sequence[str], shared: Sequence[str]) -> str:
    return ", ".join((name, *(s for s in settings if s not in shared)))


def _grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def _known(values: Iterable[float]) -> list[float]:
    return [value for value in values if not math.isnan(value)]
