"""Seconds until the picture is as good: when each variant first reaches the PSNR that the reference ends with.

A variant is a list of overrides, and the first is the reference. Each training is one process; the variants of a scene and a
seed follow each other before the next seed, so that other work on the machine slows all of them alike. A finished training
is kept. The test views are evaluated all along a run, all of them, and the training's clock stands still meanwhile.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd
import torch

from clear_strategies import files
from clear_strategies.bench import plots
from clear_strategies.bench.results import Results, environment
from clear_strategies.commands.train import quoted
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError
from clear_strategies.report.runs import history
from clear_strategies.schedules import REFERENCE_ITERATIONS
from clear_strategies.training.clock import PROBE, PROCESSOR, WALL

DEFAULTS: Final = "defaults"
_COMMAND: Final = "command.json"
_ALL: Final = 1_000_000  # test views

# Checkpoints, pages and pictures would count as the command's seconds.
_COMMON: Final = (
    f"fit.probe_views={_ALL}", "fit.checkpoint_every=0", "fit.map_views=0", "fit.video=0", "fit.page=0",
)  # fmt: skip
_RESERVED: Final = {
    "scene", "fit.probe_every", "fit.seed", "fit.threads", "fit.resume", "fit.baseline",
    *(override.partition("=")[0] for override in _COMMON),
}  # fmt: skip

Trainer = Callable[[Path, Sequence[str]], str | None]
"""Trains into a folder with overrides; returns the line that says why it failed, or None."""


@dataclass(frozen=True, slots=True)
class Request:
    """The options of the command line. A variant's overrides win over those of all trainings."""

    overrides: Sequence[str]
    variants: Sequence[Sequence[str]]
    scene: Sequence[str]
    seeds: Sequence[int]
    probes: int
    out: Path

    def __post_init__(self) -> None:
        for override in (*self.overrides, *(x for variant in self.variants for x in variant)):
            key = override.lstrip("+~").partition("=")[0]
            if key in _RESERVED or key.startswith(("hydra.", "hydra/")):
                raise DataError("seconds", override, "is set by the benchmark", "leave it out, or use its options")
        if not 1 <= self.probes <= REFERENCE_ITERATIONS:
            raise DataError("--probes", str(self.probes), f"lies outside 1 to {REFERENCE_ITERATIONS}", "give fewer")

    def training(self, scene: str | None, variant: Sequence[str], seed: int) -> tuple[Path, list[str]]:
        """The folder of a training, whose name ends in a hash of its overrides, and these overrides."""
        threads = f"fit.threads={torch.get_num_threads()}"
        own = (f"fit.seed={seed}", f"fit.probe_every={REFERENCE_ITERATIONS // self.probes}", threads)
        of_scene = [] if scene is None else [f"+scene={scene}"]
        overrides = [*of_scene, *self.overrides, *_COMMON, *own, *variant]
        digest = hashlib.sha256("\n".join(overrides).encode()).hexdigest()[:10]
        name = re.sub(r"\W+", "_", f"{scene or 'run'} {name_of(variant)}")[:60]
        return self.out / f"{name}_seed{seed}_{digest}", overrides


def name_of(variant: Sequence[str]) -> str:
    """A variant's name in the tables: its overrides, without values that name a folder."""
    return _without_folders(variant) or DEFAULTS


def _without_folders(overrides: Sequence[str]) -> str:
    """The overrides of which published tables may speak."""
    return " ".join(override for override in overrides if os.sep not in override.partition("=")[2])


def train(folder: Path, overrides: Sequence[str]) -> str | None:
    """Train in a process of its own; returns the line that says why it failed, or None."""
    program = [sys.executable, "-m", "clear_strategies.run", "fit.baseline=false"]
    child = subprocess.run(  # noqa: S603 - this interpreter
        [*program, *overrides, f"hydra.run.dir={quoted(str(folder.resolve()))}"],
        env=environment(), capture_output=True, text=True, errors="replace", check=False,
    )  # fmt: skip
    if child.returncode == 0:
        return None
    lines = [line for line in (child.stdout + child.stderr).splitlines() if line.strip()]
    # Hydra's own errors name the problem first; the run and Python name it last.
    of_hydra = [line for line in lines if line.startswith(("In '", "Could not", "Error"))]
    return (of_hydra or lines[-1:] or [f"its process ended with code {child.returncode}"])[0].strip()


def measure(results: Results, request: Request, trainer: Trainer = train) -> None:
    """Train what is not finished yet, and say when each variant reached the reference: a DataError if none finished."""
    rows: list[dict[str, Any]] = []
    probes: list[dict[str, Any]] = []
    scenes: Sequence[str | None] = request.scene or [None]
    reference, *others = request.variants
    for seed, scene in itertools.product(request.seeds, scenes):
        first = _train(results, request, (scene, reference, seed), trainer)
        if first is None:
            continue  # there is nothing to compare with
        trainings = [first, *(_train(results, request, (scene, variant, seed), trainer) for variant in others)]
        finished = [training for training in trainings if training is not None]
        rows += [training.row(first.psnr) for training in finished]
        probes += [
            {**training.facts, "t": int(probe["t"]), "training_s": probe[WALL], "psnr": probe["psnr_test"]}
            for training in finished
            for probe in training.probes
        ]
    if not rows:
        raise DataError("seconds", "trainings", "no reference finished", "see the lines above")
    table = pd.DataFrame(rows)
    curves = pd.DataFrame(probes)
    results.tables |= {"seconds": summary(table), "seconds_turns": table, "seconds_probes": curves}
    results.figures["time_against_quality"] = plots.time_against_quality(curves)
    shared = " ".join(filter(None, (_without_folders(request.overrides), *_COMMON)))
    results.note(
        f"the reference is {name_of(reference)!r}; test views are evaluated {request.probes} times a run; all trainings: {shared}"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """A finished training.

    Args:
        facts: scene, variant and seed.
        probes: the rows of its history with the PSNR of the test views.
        command: seconds of the whole command without the evaluations on the way, by the clock's columns.
    """

    facts: Mapping[str, Any]
    probes: Sequence[Mapping[str, float]]
    command: Mapping[str, float]

    @property
    def psnr(self) -> float:
        """At the end, dB."""
        return self.probes[-1]["psnr_test"]

    def row(self, target: float) -> dict[str, Any]:
        """Its row in the table. `reached` is the iteration that first has the target, and its seconds; NaN: none has."""
        end = self.probes[-1]
        first = next((probe for probe in self.probes if probe["psnr_test"] >= target), {})
        row = {**self.facts, "iterations": int(end["t"]), "psnr": self.psnr, "target": target}
        row["reached"] = first.get("t", float("nan"))
        for clock, suffix in ((WALL, "_s"), (PROCESSOR, "_processor_s")):
            seconds = first.get(clock, float("nan"))
            row |= {
                f"training{suffix}": end[clock],
                f"reached_training{suffix}": seconds,
                f"command{suffix}": self.command[clock],
                f"reached_command{suffix}": self.command[clock] - end[clock] + seconds,
            }
        return row


def summary(trainings: pd.DataFrame) -> pd.DataFrame:
    """One row per scene and variant: medians over the seeds of what is paired with the reference of the same seed.

    `psnr_over` is the final PSNR over the reference's, dB. `training`, `command` and their `_processor` are the seconds until
    the reference's final PSNR over those that the reference took for it; `of_run` compares with the whole training of
    the reference. `_low` and `_high` are the extremes over the seeds; a seed that did not reach it is missing in all of them,
    and `seeds_reached` counts the others.
    """
    reference = trainings.iloc[0]["variant"]
    base = trainings[trainings["variant"] == reference].set_index(["scene", "seed"])
    paired = trainings.join(base.add_suffix("_base"), on=["scene", "seed"])
    paired["psnr_over"] = paired["psnr"] - paired["psnr_base"]
    ratios = ["training", "training_processor", "command", "command_processor"]
    for ratio in ratios:
        paired[ratio] = paired[f"reached_{ratio}_s"] / paired[f"reached_{ratio}_s_base"]
    paired["of_run"] = paired["reached_training_processor_s"] / paired["training_processor_s_base"]
    groups = paired.groupby(["scene", "variant"], sort=False)
    table = groups[["iterations", "psnr", "psnr_over", *ratios, "of_run"]].median()
    for column in ("psnr_over", "training_processor"):
        table[f"{column}_low"], table[f"{column}_high"] = groups[column].min(), groups[column].max()
    table["seeds"], table["seeds_reached"] = groups["seed"].count(), groups["reached"].count()
    return table.reset_index()


def _train(
    results: Results, request: Request, what: tuple[str | None, Sequence[str], int], trainer: Trainer
) -> Training | None:
    """Train, or read what was trained; None if that failed, with a note."""
    scene, variant, seed = what
    folder, overrides = request.training(scene, variant, seed)
    says = f"{scene or 'run'}, {name_of(variant)}, seed {seed}"
    kept = (folder / _COMMAND).is_file()  # written last
    try:
        if not kept:
            before = _clocks()
            if (problem := trainer(folder, overrides)) is not None:
                raise DataError(folder.name, "training", problem, "see its log")
            files.write_json(folder / _COMMAND, {name: now - before[name] for name, now in _clocks().items()})
        training = _read(folder, {"variant": name_of(variant), "seed": seed})
    except DataError as error:
        results.note(f"{says}: {error}".replace(str(folder.resolve()), folder.name))
        return None
    end = training.probes[-1]
    results.log(
        f"{says}: {training.psnr:.2f} dB, {end[WALL]:.1f} s, of processors {end[PROCESSOR]:.1f}{', kept' * kept}"
    )
    return training


def _clocks() -> dict[str, float]:
    """The time now, and that of the processors in all processes that this one started and that ended."""
    times = os.times()
    return {WALL: time.perf_counter(), PROCESSOR: times.children_user + times.children_system}


def _read(folder: Path, facts: Mapping[str, Any]) -> Training:
    metrics, command, rows = read_object(folder / "metrics.json"), read_object(folder / _COMMAND), history(folder)
    probes = [row for row in rows if "psnr_test" in row]
    if not probes or any(name not in probes[-1] for name in (WALL, PROCESSOR)):
        raise DataError(folder / "history.csv", "psnr_test", "has no value", "give a data set with HR test photos")
    evaluating = {name: sum(row.get(PROBE + name, 0.0) for row in rows) for name in (WALL, PROCESSOR)}
    return Training(
        {"scene": metrics["scene"], **facts, "gaussians": metrics["gaussians"]},
        probes,
        {name: float(command[name]) - seconds for name, seconds in evaluating.items()},
    )
