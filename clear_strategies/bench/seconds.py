"""Seconds until a variant first reaches the PSNR that the reference ends with.

A variant is a list of overrides, and the first is the reference. Each training is one process; the variants of a scene and a
seed follow each other before the next seed, so that other work on the machine slows all of them alike. A finished training
is kept. All test views are evaluated repeatedly during a training, whose clock stops meanwhile.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd
import torch
from matplotlib.figure import Figure

from clear_strategies import files
from clear_strategies.bench.results import Results, line_chart
from clear_strategies.commands.train import quoted
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError
from clear_strategies.report.runs import history
from clear_strategies.schedules import REFERENCE_ITERATIONS
from clear_strategies.training.clock import PROBE, PROCESSOR, WALL

DEFAULTS: Final = "defaults"
_COMMAND: Final = "command.json"

# Every test view is evaluated. Checkpoints, pages and pictures would count as the command's seconds.
_COMMON: Final = (
    "fit.probe_views=1000000", "fit.checkpoint_every=0", "fit.map_views=0", "fit.video=0", "fit.page=0",
)  # fmt: skip
_RESERVED: Final = {
    "scene", "fit.probe_every", "fit.seed", "fit.threads", "fit.resume",
    *(override.partition("=")[0] for override in _COMMON),
}  # fmt: skip

Row = dict[str, Any]


def train(folder: Path, overrides: Sequence[str]) -> str | None:
    """Train in a process of its own; returns the line of its output that explains a failure, else None."""
    program = [sys.executable, "-m", "clear_strategies.run"]
    child = subprocess.run(  # noqa: S603 - this interpreter
        [*program, *overrides, f"hydra.run.dir={quoted(str(folder.resolve()))}"],
        capture_output=True, text=True, errors="replace", check=False,
    )  # fmt: skip
    if child.returncode == 0:
        return None
    lines = [line for line in (child.stdout + child.stderr).splitlines() if line.strip()]
    # Hydra's errors name the problem in the first line; those of a run and of Python in the last.
    of_hydra = [line for line in lines if line.startswith(("In '", "Could not", "Error"))]
    return (of_hydra or lines[-1:] or [f"its process ended with code {child.returncode}"])[0].strip()


def measure(
    results: Results,
    *,
    overrides: Sequence[str],
    variants: Sequence[Sequence[str]],
    scene: Sequence[str],
    seeds: Sequence[int],
    probes: int,
) -> None:
    """Train what is not finished yet, and compare when each variant reached the reference.

    Args:
        overrides: of all trainings; those of a variant win over them.

    Raises:
        DataError: an override is the benchmark's own, there are too many probes, or no reference finished.
    """
    _require_free([*overrides, *itertools.chain(*variants)])
    if not 1 <= probes <= REFERENCE_ITERATIONS:
        raise DataError("--probes", str(probes), f"lies outside 1 to {REFERENCE_ITERATIONS}", "give fewer")
    shared = [*overrides, *_COMMON, f"fit.probe_every={REFERENCE_ITERATIONS // probes}"]
    rows, curves = list[Row](), list[Row]()
    for seed, name in itertools.product(seeds, scene or [""]):
        common = [*([f"+scene={name}"] if name else []), *shared, f"fit.seed={seed}"]
        common.append(f"fit.threads={torch.get_num_threads()}")
        target: float | None = None
        for variant in variants:
            chosen, label = [*common, *variant], f"{name or 'run'}, {name_of(variant)}, seed {seed}"
            # The folder's name ends in a hash of the overrides.
            digest = hashlib.sha256("\n".join(chosen).encode()).hexdigest()[:10]
            folder = (results.out or Path()) / (re.sub(r"\W+", "_", label)[:60] + f"_{digest}")
            try:
                kept = _trained(folder, chosen)
                row, curve = read(folder, target, variant=name_of(variant), seed=seed)
            except DataError as error:
                results.note(f"{label}: {error}".replace(str(folder.resolve()), folder.name))
                if target is None:
                    break  # there is nothing to compare with
                continue
            target = row["target"]
            rows.append(row)
            curves += curve
            took = f"{row['training_s']:.1f} s, of processors {row['training_processor_s']:.1f}{', kept' * kept}"
            results.log(f"{label}: {row['psnr']:.2f} dB, {took}")
    if not rows:
        raise DataError("seconds", "trainings", "no reference finished", "see the lines above")
    table, probed = pd.DataFrame(rows), pd.DataFrame(curves)
    results.tables |= {"seconds": summary(table), "seconds_turns": table, "seconds_probes": probed}
    results.figures["time_against_quality"] = figure(probed)
    results.note(f"the reference is {name_of(variants[0])!r}; all trainings: {name_of(shared)}")


def figure(curves: pd.DataFrame) -> Figure:
    """A line per training; upper left is better."""
    names = {"training_s": "seconds of training", "psnr": "PSNR of the test views, dB", "variant": "name"}
    ends = ~curves.duplicated(["scene", "variant", "seed"], keep="last")
    rows = curves.assign(line=curves["seed"], mark=curves["seed"].astype(str).where(ends, "")).rename(columns=names)
    return line_chart(rows, names["training_s"], names["psnr"])


def name_of(variant: Sequence[str]) -> str:
    """A variant's name in the tables: its overrides, without values that name a folder."""
    return " ".join(override for override in variant if os.sep not in override.partition("=")[2]) or DEFAULTS


def _require_free(overrides: Sequence[str]) -> None:
    for override in overrides:
        key = override.lstrip("+~").partition("=")[0]
        if key in _RESERVED or key.startswith(("hydra.", "hydra/")):
            raise DataError("seconds", override, "is set by the benchmark", "leave it out, or use its options")


def summary(trainings: pd.DataFrame) -> pd.DataFrame:
    """One row per scene and variant: medians over the seeds of what is paired with the reference of the same seed.

    `psnr_over` is the final PSNR over the reference's, dB. `training`, `command` and their `_processor` are the seconds until
    the reference's final PSNR over those that the reference took for it; `of_run` compares with the whole training of
    the reference. `_low` and `_high` are the extremes over the seeds; a seed that did not reach it is missing in all of them,
    and `seeds_reached` counts the others.
    """
    base = trainings[trainings["variant"] == trainings.iloc[0]["variant"]].set_index(["scene", "seed"])
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


def _trained(folder: Path, overrides: Sequence[str]) -> bool:
    """Train into the folder, unless that is done; returns whether it was. Raises a DataError where training fails."""
    if (folder / _COMMAND).is_file():  # written last
        return True
    before = _clocks()
    if (problem := train(folder, overrides)) is not None:
        raise DataError(folder.name, "training", problem, "see its log")
    files.write_json(folder / _COMMAND, {name: now - before[name] for name, now in _clocks().items()})
    return False


def _clocks() -> dict[str, float]:
    """Wall-clock time, and the processor time of all child processes that have ended, s."""
    times = os.times()
    return {WALL: time.perf_counter(), PROCESSOR: times.children_user + times.children_system}


def read(folder: Path, target: float | None, **facts: Any) -> tuple[Row, list[Row]]:
    """The row of a finished training in the table, and the PSNR of its test views at each evaluation.

    `reached` is the first iteration with at least the target PSNR, NaN where none has it; `reached_…` are the seconds until
    then. The command's seconds leave out the evaluations.

    Args:
        target: dB; None: the training's own last PSNR.
    """
    metrics, command, rows = read_object(folder / "metrics.json"), read_object(folder / _COMMAND), history(folder)
    probes = [row for row in rows if "psnr_test" in row]
    if not probes or any(name not in probes[-1] for name in (WALL, PROCESSOR)):
        raise DataError(folder / "history.csv", "psnr_test", "has no value", "give a data set with HR test photos")
    end, shared = probes[-1], {"scene": metrics["scene"], **facts, "gaussians": metrics["gaussians"]}
    target = end["psnr_test"] if target is None else target
    first = next((probe for probe in probes if probe["psnr_test"] >= target), {})
    row = {**shared, "iterations": int(end["t"]), "psnr": end["psnr_test"], "target": target}
    row["reached"] = first.get("t", float("nan"))
    for clock, suffix in ((WALL, "_s"), (PROCESSOR, "_processor_s")):
        seconds = first.get(clock, float("nan"))
        whole = float(command[clock]) - sum(other.get(PROBE + clock, 0.0) for other in rows)
        row |= {f"training{suffix}": end[clock], f"reached_training{suffix}": seconds}
        row |= {f"command{suffix}": whole, f"reached_command{suffix}": whole - end[clock] + seconds}
    return row, [{**shared, "t": int(p["t"]), "training_s": p[WALL], "psnr": p["psnr_test"]} for p in probes]
