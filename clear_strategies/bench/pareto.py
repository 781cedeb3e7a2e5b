"""What does each second buy? Seconds against PSNR and SSIM of whole trainings, over everything that trades one for the
other: strategies, inexact skips, cut-offs, backends, and simply to train for less, the peer that every skip must beat.

Each training is one process. Variants take turns, one seed after the other, so that the machine's other work hits all
alike; a training whose result lies in the folder already is kept.
"""

from __future__ import annotations

import csv
import hashlib
import math
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import torch

from clear_strategies.bench.output import UNKNOWN, Findings, Section, number, times
from clear_strategies.bench.rasterizers import usable
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError
from clear_strategies.report.runs import Run, history
from clear_strategies.training.evaluation import PROBING

STRATEGIES, SKIPS, LENGTH, CUT_OFFS, BACKEND = "strategies", "skips", "run length", "cut-offs", "backend"
KINDS: Final = (STRATEGIES, SKIPS, LENGTH, CUT_OFFS, BACKEND)


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to train.

    Args:
        name: what tables and pictures call it.
        kind: of `KINDS`, what it varies.
        overrides: Hydra's, after `_COMMON`.
        length: share of the iterations that were asked for; milestones are stretched to what remains.
    """

    name: str
    kind: str
    overrides: tuple[str, ...]
    length: float = 1.0


_CLEAR: Final = "+strategy=clear"
_COARSE, _SELDOM, _FLAT = "skips.coarse_until=3000", "skips.hr_every=2", "skips.flat=0.01"
_PLATEAU: Final = ("skips.plateau_gain=0.01", "skips.plateau_window=250")

REFERENCE: Final = Variant("clear", STRATEGIES, (_CLEAR,))
"""Every inexact skip off, the fast cut-offs: what the others are compared with."""

VARIANTS: Final = (
    Variant("LR only", STRATEGIES, ("+strategy=baseline", "objective=lr_only")),
    Variant("baseline", STRATEGIES, ("+strategy=baseline",)),
    Variant("gco", STRATEGIES, ("+strategy=gco",)),
    Variant("gco + p2g", STRATEGIES, ("+strategy=[gco,p2g]",)),
    REFERENCE,
    Variant("coarse first", SKIPS, (_CLEAR, _COARSE)),
    Variant("HR every 2nd", SKIPS, (_CLEAR, _SELDOM)),
    Variant("no flat tiles", SKIPS, (_CLEAR, _FLAT)),
    Variant("no plateau", SKIPS, (_CLEAR, *_PLATEAU)),
    Variant("all four skips", SKIPS, (_CLEAR, _COARSE, _SELDOM, _FLAT, *_PLATEAU)),
    Variant("default skips", SKIPS, (_CLEAR, "skips=measured")),
    Variant("3/4 as long", LENGTH, (_CLEAR,), length=0.75),
    Variant("1/2 as long", LENGTH, (_CLEAR,), length=0.5),
    Variant("1/4 as long", LENGTH, (_CLEAR,), length=0.25),
    Variant("accurate", CUT_OFFS, (_CLEAR, "rasterizer.preset=accurate")),
)

# Of two overrides of one setting Hydra takes the later, so that a variant has the last word.
_COMMON: Final = (
    "skips=none",
    "rasterizer.preset=fast",
    "fit.probe_every=500",  # (10k): twenty looks a run
    "fit.probe_views=1000000",  # all test views, so that a curve ends where its marker is
    "fit.checkpoint_every=0",  # saving would count as training
    "fit.map_views=0",
)
# What the benchmark sets itself.
_TAKEN: Final = re.compile(
    r"[+~]*(strategy|skips|rasterizer|rasterizer\.preset|objective\.kernels|hydra[./].*"
    r"|fit\.(iterations|seed|threads|resume|probe_every|probe_views|checkpoint_every|map_views))(=|$)"
)


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for on the command line.

    Args:
        overrides: of the scene and whatever else all variants share; none: the demo.
        out: where the trainings are kept.
        backends: the first trains every variant, each further one trains `REFERENCE` once more.
        variants: names of `VARIANTS`.
    """

    overrides: tuple[str, ...]
    seeds: tuple[int, ...]
    iterations: int
    out: Path
    backends: tuple[str, ...]
    variants: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """A finished training.

    Args:
        seconds: of its loop, without looking at test views.
        curve: seconds, so counted, and PSNR of the test views in dB, at every look.
        commit: of the source that trained it.
    """

    scene: str
    seed: int
    iterations: int
    gaussians: float
    seconds: float
    psnr: float
    ssim: float
    curve: tuple[tuple[float, float], ...]
    commit: str

    @classmethod
    def read(cls, folder: Path) -> Training:
        """Of the folder that the run left.

        Raises:
            DataError: one of its files is missing or damaged.
        """
        run, rows = Run.read(folder), history(folder)
        if not rows or any("seconds" not in row for row in rows):
            raise DataError(
                folder / "history.csv", "seconds", "are missing", "remove the folder, and it is trained again"
            )
        look, looks, seconds, curve = _look(folder / "timing.csv"), 0, 0.0, []
        for row in rows:
            seconds = row["seconds"] - looks * look  # a row's seconds end before its own look
            if "psnr_test" in row:
                curve.append((seconds, row["psnr_test"]))
                looks += 1
        ours, origin = run.scores["ours"], read_object(folder / "metrics.json").get("provenance", {})
        return cls(
            run.scene, run.seed, run.iterations, run.facts["gaussians"], seconds, ours["psnr"], ours["ssim"],
            tuple(curve), str(origin.get("git", "unknown")),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """A variant's trainings, one a seed."""

    variant: Variant
    trainings: tuple[Training, ...]

    def mean(self, quantity: str) -> float:
        """Over the seeds, of "seconds", "psnr" or "ssim"."""
        return statistics.fmean(self.values(quantity))

    def values(self, quantity: str) -> list[float]:
        return [getattr(training, quantity) for training in self.trainings]

    def paired(self, other: Row, quantity: str) -> list[tuple[float, float]]:
        """(ours, theirs) for each seed that both have."""
        theirs = {t.seed: getattr(t, quantity) for t in other.trainings}
        return [(getattr(t, quantity), theirs[t.seed]) for t in self.trainings if t.seed in theirs]


def measure(request: Request, say: Callable[[str], None]) -> tuple[Findings, list[Row]]:
    """Train what is not there yet, and set everything side by side, by seconds.

    Raises:
        DataError: an override is the benchmark's own to set, a name is unknown, or no training finished.
    """
    findings = Findings("pareto", torch.get_num_threads())

    def skip(line: str) -> None:
        say(line)
        findings.skipped.append(line)

    variants = _chosen(request, skip)
    found: dict[Variant, list[Training]] = {variant: [] for variant in variants}
    turns = [(seed, variant) for seed in request.seeds for variant in variants]
    failed: set[Variant] = set()
    for turn, (seed, variant) in enumerate(turns, 1):
        if variant in failed:
            continue
        training, kept = _trained(request, variant, seed, findings.threads)
        if isinstance(training, str):
            failed.add(variant)
            skip(f"{variant.name}, seed {seed}{' and later' * (seed != request.seeds[-1])}: {training}")
            continue
        found[variant].append(training)
        result = f"{training.seconds:.1f} s, {training.psnr:.2f} dB, SSIM {training.ssim:.4f}"
        say(f"{turn} of {len(turns)}: {variant.name}, seed {seed}: {result}{', kept' * kept}")
    rows = [Row(variant, tuple(trainings)) for variant, trainings in found.items() if trainings]
    if not rows:
        raise DataError("pareto", "trainings", "none finished", "see the lines above")
    rows.sort(key=lambda row: row.mean("seconds"))
    best = front(rows)
    findings.sections = [_section(request, rows, best)]
    findings.raw = {
        "overrides": _without_paths(request.overrides), "iterations": request.iterations, "seeds": request.seeds,
        "rows": [
            {**asdict(row.variant), "front": row in best, "trainings": [asdict(t) for t in row.trainings]} for row in rows
        ],
    }  # fmt: skip
    return findings, rows


def front(rows: Sequence[Row]) -> list[Row]:
    """Those than which no other has more PSNR in as little time, by seconds."""
    best, found = -math.inf, []
    for row in sorted(rows, key=lambda row: (row.mean("seconds"), -row.mean("psnr"))):
        if row.mean("psnr") > best:
            best = row.mean("psnr")
            found.append(row)
    return found


def folder_of(request: Request, variant: Variant, seed: int, threads: int) -> tuple[Path, list[str]]:
    """Where a training belongs, and its overrides: a folder's name ends in what its overrides hash to."""
    overrides = [
        *request.overrides, *_COMMON, *variant.overrides,
        f"fit.iterations={max(1, round(variant.length * request.iterations))}", f"fit.seed={seed}", f"fit.threads={threads}",
    ]  # fmt: skip
    digest = hashlib.sha256("\n".join(overrides).encode()).hexdigest()[:10]
    name = re.sub(r"\W+", "_", variant.name)
    return request.out / f"{name}_seed{seed}_{digest}", overrides


def _chosen(request: Request, skip: Callable[[str], None]) -> list[Variant]:
    for override in request.overrides:
        if _TAKEN.match(override):
            raise DataError("pareto", override, "is for the benchmark to set", "leave it out; see --help")
    known = {variant.name: variant for variant in VARIANTS}
    for name in request.variants:
        if name not in known:
            raise DataError("--variants", name, "is no variant", f"choose of {', '.join(known)}")
    first, *others = usable(request.backends, "cpu", skip)
    chosen = [_on(first, known[name]) for name in dict.fromkeys(request.variants)]
    return chosen + [Variant(f"{name} backend", BACKEND, _on(name, REFERENCE).overrides) for name in others]


def _on(backend: str, variant: Variant) -> Variant:
    """The variant with this rasterizer, and with image losses of the same make."""
    makes = (f"rasterizer={backend}", f"objective.kernels={'torch' if backend == 'torch' else 'auto'}")
    return Variant(variant.name, variant.kind, (*makes, *variant.overrides), variant.length)


def _trained(request: Request, variant: Variant, seed: int, threads: int) -> tuple[Training | str, bool]:
    """The training, or why there is none, and whether it was there before."""
    folder, overrides = folder_of(request, variant, seed, threads)
    kept = (folder / "metrics.json").is_file()  # written last
    if not kept and (problem := _train(folder, overrides)) is not None:
        return problem.replace(str(folder), folder.name), False
    try:
        return Training.read(folder), kept
    except DataError as error:
        return str(error).replace(str(folder), folder.name), kept


def _train(folder: Path, overrides: Sequence[str]) -> str | None:
    """One process; the line that says why it failed, or None."""
    root = Path(__file__).resolve().parents[2]
    paths = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
    where = str(folder.resolve()).replace("\\", "\\\\").replace("'", "\\'")
    command = [sys.executable, "-m", "clear_strategies.run", *overrides, f"hydra.run.dir='{where}'"]
    child = subprocess.run(  # noqa: S603 - this very interpreter
        command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, errors="replace", check=False
    )
    if child.returncode == 0:
        return None
    said = [line for line in (child.stdout + child.stderr).splitlines() if line.strip()]
    # Hydra says what is wrong first, and then what else there is; the run and Python say it last.
    composing = [line for line in said if line.startswith(("In '", "Could not", "Error"))]
    return (composing or said[-1:] or [f"its process ended with code {child.returncode}"])[0].strip()


def _look(path: Path) -> float:
    """Seconds that one look at the test views took, on average.

    Raises:
        DataError: the table cannot be read.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return sum(float(row["ms_each"]) / 1e3 for row in csv.DictReader(file) if row["stage"] == PROBING)
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise DataError(
            path, "table", f"cannot be read ({error})", "remove the folder, and it is trained again"
        ) from error


def _section(request: Request, rows: Sequence[Row], best: Sequence[Row]) -> Section:
    reference = next((row for row in rows if row.variant.name == REFERENCE.name), None)
    columns = {
        "variant": [row.variant.name for row in rows],
        "varies": [row.variant.kind for row in rows],
        "iterations": [f"{statistics.fmean(row.values('iterations')):,.0f}" for row in rows],
        "Gaussians": [f"{statistics.fmean(row.values('gaussians')):,.0f}" for row in rows],
        "seconds": [_spread(row.values("seconds"), number) for row in rows],
        f"of {REFERENCE.name}": [_ratio(row, reference) for row in rows],
        "PSNR (dB)": [_spread(row.values("psnr"), lambda x: f"{x:.2f}") for row in rows],
        "Δ": [_difference(row, reference) for row in rows],
        "SSIM": [_spread(row.values("ssim"), lambda x: f"{x:.4f}") for row in rows],
        "front": ["yes" if row in best else "" for row in rows],
    }
    seeds = f"seed{'s' * (len(request.seeds) > 1)} {', '.join(map(str, request.seeds))}"
    notes = [
        f'Seconds: of the training loop (history.csv) without its looks at the test views (the work_log\'s "{PROBING}"); '
        'start-up, the last checkpoint, "evaluate" and the pictures lie outside of the loop. PSNR and SSIM: mean over '
        f"the test views at the end. Of {REFERENCE.name}, and Δ in dB: against {REFERENCE.name} with every inexact skip "
        "off, paired by seed. front: nothing here reaches its PSNR in as little time."
        + " ±: standard deviation over seeds."
        * (len(request.seeds) > 1)
    ]
    if shared := _without_paths(request.overrides):
        notes.append(f"All trainings: `{' '.join(shared)}`.")
    for row in rows:
        if len(row.trainings) < len(request.seeds):
            notes.append(f"{row.variant.name}: {len(row.trainings)} of {len(request.seeds)} seeds.")
    if len(commits := sorted({t.commit[:10] for row in rows for t in row.trainings})) > 1:
        notes.append(f"Trained by different sources, kept from earlier measurements: commits {', '.join(commits)}.")
    return Section(f"{rows[0].trainings[0].scene}: {request.iterations:,} iterations, {seeds}", columns, notes)


def _ratio(row: Row, reference: Row | None) -> str:
    pairs = row.paired(reference, "seconds") if reference is not None else []
    return times(sum(a for a, _ in pairs) / sum(b for _, b in pairs)) if pairs else UNKNOWN


def _difference(row: Row, reference: Row | None) -> str:
    pairs = row.paired(reference, "psnr") if reference is not None else []
    return f"{statistics.fmean(a - b for a, b in pairs):+.2f}" if pairs else UNKNOWN


def _spread(values: Sequence[float], written: Callable[[float], str]) -> str:
    mean = written(statistics.fmean(values))
    return mean if len(values) == 1 else f"{mean} ± {written(statistics.stdev(values))}"


def _without_paths(overrides: Sequence[str]) -> list[str]:
    """A published figure names nobody's folders."""
    return [override for override in overrides if os.sep not in override.partition("=")[2]]
