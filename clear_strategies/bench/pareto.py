"""Seconds against PSNR and SSIM of whole trainings: what each second buys.

The variants are everything that trades time for quality: strategies, inexact skips, cut-offs, and
simply training for fewer iterations, which every skip must beat. Each training is one process. All
variants are trained with one seed before any with the next, so that other work on the machine slows
all of them alike; a finished training is kept.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd
import torch

from clear_strategies.bench import plots
from clear_strategies.bench.results import Results
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError
from clear_strategies.report.runs import Run, history

STRATEGIES, SKIPS, LENGTH, CUT_OFFS = "strategies", "skips", "run length", "cut-offs"


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to train.

    Args:
        kind: what it varies.
        overrides: Hydra's, after `_COMMON`.
        length: the share of the iterations that it trains; milestones stretch with it.
    """

    name: str
    kind: str
    overrides: tuple[str, ...]
    length: float = 1.0


_CLEAR: Final = "+strategy=clear"
_COARSE, _SELDOM = "skips.coarse_until=3000", "skips.hr_every=2"
_PLATEAU: Final = ("skips.plateau_gain=0.01", "skips.plateau_window=250")

BASE: Final = Variant("clear", STRATEGIES, (_CLEAR,))
"""CLEAR without inexact skips at the fast cut-offs; the others are compared with it."""

VARIANTS: Final = (
    Variant("LR only", STRATEGIES, ("+strategy=baseline", "objective=lr_only")),
    Variant("baseline", STRATEGIES, ("+strategy=baseline",)),
    Variant("gco", STRATEGIES, ("+strategy=gco",)),
    Variant("gco + p2g", STRATEGIES, ("+strategy=[gco,p2g]",)),
    BASE,
    Variant("coarse first", SKIPS, (_CLEAR, _COARSE)),
    Variant("HR every 2nd", SKIPS, (_CLEAR, _SELDOM)),
    Variant("no plateau", SKIPS, (_CLEAR, *_PLATEAU)),
    Variant("all three skips", SKIPS, (_CLEAR, _COARSE, _SELDOM, *_PLATEAU)),
    Variant("default skips", SKIPS, (_CLEAR, "skips=measured")),
    Variant("3/4 as long", LENGTH, (_CLEAR,), length=0.75),
    Variant("1/2 as long", LENGTH, (_CLEAR,), length=0.5),
    Variant("1/4 as long", LENGTH, (_CLEAR,), length=0.25),
    Variant("accurate", CUT_OFFS, (_CLEAR, "rasterizer.preset=accurate")),
)

# A variant wins over these: Hydra takes the last override. Probes and checkpoints would count as time.
_COMMON: Final = (
    "skips=none", "rasterizer.preset=fast", "fit.probe_every=0", "fit.checkpoint_every=0", "fit.map_views=0", "fit.video=0",
)  # fmt: skip
_RESERVED: Final = {
    "strategy", "fit.iterations", "fit.seed", "fit.threads", "fit.resume", *(override.partition("=")[0] for override in _COMMON)
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Request:
    """The options of the command line.

    Args:
        overrides: shared by all trainings; none: the demo.
        out: holds the trainings.
        variants: names of `VARIANTS`.
    """

    overrides: Sequence[str]
    seeds: Sequence[int]
    iterations: int
    out: Path
    variants: Sequence[str]


def train(folder: Path, overrides: Sequence[str]) -> str | None:
    """Train in a process of its own; returns the line that says why it failed, or None."""
    root = Path(__file__).resolve().parents[2]
    paths = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
    where = str(folder.resolve()).replace("\\", "\\\\").replace("'", "\\'")
    command = [
        sys.executable,
        "-m",
        "clear_strategies.run",
        "fit.baseline=false",
        *overrides,
        f"hydra.run.dir='{where}'",
    ]
    child = subprocess.run(  # noqa: S603 - this interpreter
        command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, errors="replace", check=False
    )
    if child.returncode == 0:
        return None
    lines = [line for line in (child.stdout + child.stderr).splitlines() if line.strip()]
    # Hydra's own errors name the problem first; the run and Python name it last.
    of_hydra = [line for line in lines if line.startswith(("In '", "Could not", "Error"))]
    return (of_hydra or lines[-1:] or [f"its process ended with code {child.returncode}"])[0].strip()


def measure(results: Results, request: Request, trainer: Callable[[Path, Sequence[str]], str | None] = train) -> None:
    """Train what is not finished yet, and compare all trainings.

    Args:
        trainer: trains into a folder with overrides.

    Raises:
        DataError: an override is reserved, a name is unknown, or no training finished.
    """
    trainings, failed = [], set()
    variants = _chosen(request)
    for seed in request.seeds:
        for variant in variants:
            if variant.name in failed:
                continue
            folder, overrides = folder_of(request, variant, seed)
            kept = (folder / "metrics.json").is_file()  # written last
            try:
                if not kept and (problem := trainer(folder, overrides)) is not None:
                    raise DataError(folder.name, "training", problem, "see its log")
                training = _read(folder, variant)
            except DataError as error:
                failed.add(variant.name)
                results.note(f"{variant.name}, seed {seed}: {error}".replace(str(folder.resolve()), folder.name))
                continue
            trainings.append(training)
            score = f"{training['seconds']:.1f} s, {training['psnr']:.2f} dB, SSIM {training['ssim']:.4f}"
            results.log(f"{variant.name}, seed {seed}: {score}{', kept' * kept}")
    if not trainings:
        raise DataError("pareto", "trainings", "none finished", "see the lines above")
    table = pd.DataFrame(trainings)
    results.tables |= {"pareto": summary(table), "pareto_turns": table}
    title = f"{table['scene'].iloc[0]}: {request.iterations:,} iterations"
    results.figures["time_against_quality"] = plots.time_against_quality(results.tables["pareto"], title)
    # Published figures name no folders.
    shared = [override for override in request.overrides if os.sep not in override.partition("=")[2]]
    results.note(f"{title}; all trainings: {' '.join((*shared, *_COMMON))}")


def summary(trainings: pd.DataFrame) -> pd.DataFrame:
    """One row per variant: means and standard deviations over seeds, and comparisons with `BASE`.

    `time_over_clear` and `psnr_over_clear` (dB) are paired by seed. `front`: no variant has as much
    PSNR in as little time.
    """
    base = trainings[trainings["variant"] == BASE.name].set_index("seed")
    paired = trainings.join(base[["seconds", "psnr"]].add_suffix("_base"), on="seed").dropna(subset="psnr_base")
    groups = trainings.groupby(["variant", "kind"], sort=False)
    pairs = paired.groupby(["variant", "kind"], sort=False)
    table = groups[["iterations", "gaussians", "seconds", "psnr", "ssim"]].mean()
    table = table.join(groups[["seconds", "psnr", "ssim"]].std().add_suffix("_std"))
    table["seeds"] = groups["seed"].count()
    table["time_over_clear"] = pairs["seconds"].sum() / pairs["seconds_base"].sum()
    table["psnr_over_clear"] = pairs["psnr"].mean() - pairs["psnr_base"].mean()
    table = table.reset_index().sort_values(["seconds", "psnr"], ascending=[True, False], ignore_index=True)
    psnr = table["psnr"].fillna(float("-inf"))
    table["front"] = psnr > psnr.cummax().shift(fill_value=float("-inf"))
    return table


def folder_of(request: Request, variant: Variant, seed: int) -> tuple[Path, list[str]]:
    """The folder of a training, whose name ends in a hash of its overrides, and these overrides."""
    iterations = max(1, round(variant.length * request.iterations))
    own = (f"fit.iterations={iterations}", f"fit.seed={seed}", f"fit.threads={torch.get_num_threads()}")
    overrides = [*request.overrides, *_COMMON, *variant.overrides, *own]
    digest = hashlib.sha256("\n".join(overrides).encode()).hexdigest()[:10]
    name = re.sub(r"\W+", "_", variant.name)
    return request.out / f"{name}_seed{seed}_{digest}", overrides


def _chosen(request: Request) -> list[Variant]:
    for override in request.overrides:
        key = override.lstrip("+~").partition("=")[0]
        if key in _RESERVED or key.startswith(("hydra.", "hydra/")):
            raise DataError("pareto", override, "is set by the benchmark", "leave it out")
    known = {variant.name: variant for variant in VARIANTS}
    for name in request.variants:
        if name not in known:
            raise DataError("--variants", name, "is no variant", f"choose from {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(request.variants)]


def _read(folder: Path, variant: Variant) -> dict[str, Any]:
    """One row of the trainings; seconds are those of the training loop."""
    run, rows, content = Run.read(folder), history(folder), read_object(folder / "metrics.json")
    if not rows or "seconds" not in rows[-1]:
        raise DataError(folder / "history.csv", "seconds", "are missing", "remove the folder to train again")
    return {
        "variant": variant.name, "kind": variant.kind, "scene": run.scene, "seed": run.seed,
        "iterations": run.iterations, "gaussians": run.facts["gaussians"], "seconds": rows[-1]["seconds"],
        "psnr": run.scores["ours"]["psnr"], "ssim": run.scores["ours"]["ssim"],
        "git": content["provenance"].get("git", "unknown"),
    }  # fmt: skip
