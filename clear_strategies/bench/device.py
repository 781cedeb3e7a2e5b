"""Everything that only a GPU can show, in one go: tests, tables, whole trainings, same bits again, what a sanitizer finds.

A step is a command in a process of its own, its output in a log of its own. One that fails, or has nothing to run on, does
not stop the next; what became of each is the table at the end. `--device cpu --quick` is the rehearsal: the same program on
tiny scenes, every step that needs no GPU.
"""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Final

import torch

from clear_strategies.bench.output import Findings, Section, number
from clear_strategies.bench.rasterizers import require_device
from clear_strategies.errors import DataError

ROOT: Final = Path(__file__).resolve().parents[2]

PASSED, FAILED, SKIPPED = "passed", "failed", "not run"

_TINY: Final = (
    "data.reader.width=64", "data.reader.height=48", "data.reader.views=5", "data.reader.train=2", "data.views.train=2",
    "data.cloud.init=random", "data.cloud.random_points=60", "fit.iterations=12", "fit.max_degree=1",
)  # fmt: skip
_FERN: Final = {"252x189 -> 1008x756": "images_4", "504x378 -> 2016x1512": "images_2"}  # LLFF's folder of the HR photos
_FULL: Final = ("fit.iterations=10000", "data.views.shrink=1")


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for on the command line.

    Args:
        root: the folder that holds LLFF's fern. data: the garden's .npz, or its folder. scenes: .ply files or checkpoints
            to measure beside the generated scenes. quick: tiny everything, to see that the steps run.
    """

    out: Path
    device: str
    quick: bool = False
    root: Path | None = None
    data: Path | None = None
    scenes: Sequence[Path] = ()

    def resolved(self) -> Request:
        """The same for steps that run in another folder."""
        root, data = (path if path is None else path.resolve() for path in (self.root, self.data))
        scenes = tuple(path.resolve() for path in self.scenes)
        return replace(self, out=self.out.resolve(), root=root, data=data, scenes=scenes)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A command to run.

    Args:
        why_not: the reason why it cannot run here. learn: looks at what it left, and says in a phrase what that is.
    """

    name: str
    command: Sequence[str]
    why_not: str | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    learn: Callable[[], str] = lambda: ""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a step; `says` is the reason, or what was learnt."""

    name: str
    result: str
    seconds: float
    says: str
    log: str


class Unexpected(Exception):
    """A step ran, and left what it should not."""


def measure(request: Request, say: Callable[[str], None]) -> Findings:
    """All steps, one after the other.

    Raises:
        DataError: there is no such device, or the folder holds something.
    """
    require_device(request.device)
    if request.out.exists() and (not request.out.is_dir() or any(request.out.iterdir())):
        raise DataError("--out", str(request.out), "must be a new folder, or an empty one", "name another")
    request = request.resolved()
    (request.out / "logs").mkdir(parents=True, exist_ok=True)
    findings = Findings("device", torch.get_num_threads())
    outcomes = []
    for nth, step in enumerate(steps(request), 1):
        say(f"{step.name} …")
        outcomes.append(taken(step, request, request.out / "logs" / f"{nth:02}_{_slug(step.name)}.log"))
        say(f"{step.name}: {outcomes[-1].result}. {outcomes[-1].says}".strip())
    findings.sections = [_summary(outcomes), *_stages(request.out)]
    findings.failed = any(outcome.result == FAILED for outcome in outcomes)
    findings.raw = {"device": request.device, "quick": request.quick, "steps": [asdict(one) for one in outcomes]}
    return findings


def steps(request: Request) -> list[Step]:
    """What is done, in this order."""
    groups = (_tests, _first_use, _tables, _trainings, _trained, _again, _sanitized)
    return [step for group in groups for step in group(request)]


def taken(step: Step, request: Request, log: Path) -> Outcome:
    """Run it to its end, whatever that is."""
    if step.why_not is not None:
        return Outcome(step.name, SKIPPED, 0.0, step.why_not, "")
    began = time.perf_counter()
    with log.open("wb") as output:
        try:
            code = subprocess.run(  # noqa: S603 - our own programs, and NVIDIA's
                step.command, cwd=ROOT, env={**_environment(request), **step.environment}, stdout=output,
                stderr=subprocess.STDOUT, check=False,
            ).returncode  # fmt: skip
            result, says = (PASSED, step.learn()) if code == 0 else (FAILED, f"exit code {code}: {_last_line(log)}")
        except (OSError, Unexpected) as error:
            result, says = FAILED, str(error)
    return Outcome(step.name, result, round(time.perf_counter() - began, 1), says, str(log.relative_to(request.out)))


def _tests(request: Request) -> list[Step]:
    """With CUDA in sight, the tests for it run; `-rs` leaves in the log which did not, and why."""
    tests = ROOT / "tests"
    which = [tests / "test_files.py"] if request.quick else [tests]
    why_not = None if tests.is_dir() else "the tests are in a checkout, not in an installed package"
    command = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", *map(str, which)]
    return [Step("tests", command, why_not)]


def _table(request: Request, name: str, *arguments: str, why_not: str | None = None) -> Step:
    """The tables of another question, as Markdown and JSON."""
    files = ("--json", str(request.out / f"{name}.json"), "--markdown", str(request.out / f"{name}.md"))
    question, device = name.partition("_")[0], ("--device", request.device)
    command = (sys.executable, "-m", "clear_strategies.bench", question, *device, *arguments, *files)
    return Step(f"bench {name}", command, why_not, learn=lambda: f"{name}.md")


def _tables(request: Request) -> list[Step]:
    scenes = [str(path) for path in request.scenes]
    if request.quick:
        few = ("--repeats", "1", "--no-memory", "--preset", "fast")
        return [
            _table(request, "rasterizers", "--scene", "tiny", *scenes, *few),
            _table(request, "kernels", "--repeats", "1", "--size", "32x16", "--gaussians", "500"),
            _table(request, "iteration", "--repeats", "1", "--scene", "tiny"),
        ]
    picture = ("--picture", str(request.out / "rasterizers.png"), "--limit", "600")
    garden = ("--data", str(request.data)) if request.data is not None else ()
    return [
        _table(request, "rasterizers", "--scene", "s100k", "s100k-lr", "garden", "s500k", *scenes, *picture, *garden),
        _table(request, "kernels", "--size", "1008x756", "252x189", "2016x1512", "504x378"),
        _table(request, "iteration_1008", "--scene", "s100k"),
        _table(request, "iteration_2016", "--scene", "s300k-2016"),
    ]


def _trained(request: Request) -> list[Step]:
    """The same of what the first training left: Gaussians as they are, not as they were made up."""
    folder, why_not = ("demo", None) if request.quick else ("fern_images_4", _missing(request, "images_4"))
    field, few = str(request.out / "runs" / folder / "point_cloud.ply"), ("--repeats", "1") if request.quick else ()
    rasterizers = ("--scene", field, *few, *(("--no-memory", "--preset", "fast") if request.quick else ()))
    return [
        _table(request, "rasterizers_trained", *rasterizers, why_not=why_not),
        _table(request, "iteration_trained", "--scene", field, *few, why_not=why_not),
    ]


def _first_use(request: Request) -> list[Step]:
    """The same tiny picture from an empty cache of compiled kernels, and from a filled one; the seconds are the finding."""
    why_not = None if request.device == "cuda" else "it is what compiling for CUDA takes"
    environment = {"WARP_CACHE_PATH": str(request.out / "warp_cache")}
    return [
        Step(name, _training(request, name, folder, _TINY).command, why_not, environment)
        for name, folder in (
            ("first use, kernels not compiled yet", "checks/cold"),
            ("first use, kernels compiled", "checks/warm"),
        )
    ]


def _trainings(request: Request) -> list[Step]:
    """CLEAR on fern, every pixel of every iteration; `timing.csv` has the seconds by stage."""
    if request.quick:
        return [_training(request, "train, demo", "runs/demo", _TINY)]
    found = []
    for size, folder in _FERN.items():
        scene = ("+scene=fern", f"data.root={request.root}", f"data.reader.images={folder}", *_FULL)
        for name, run, skips in (("", "", ("skips=none",)), (", default skips", "_skips", ())):
            out = f"runs/fern_{folder}{run}"
            found.append(
                _training(request, f"train, fern {size}{name}", out, (*scene, *skips), _missing(request, folder))
            )
    return found


def _missing(request: Request, folder: str) -> str | None:
    """Why fern cannot be trained on the photos of a folder."""
    if request.root is None:
        return "give the folder that holds fern with --data-root"
    photos = request.root / "fern" / folder
    return None if photos.is_dir() else f"{photos} is not there"


def _training(request: Request, name: str, folder: str, overrides: Sequence[str], why_not: str | None = None) -> Step:
    out = request.out / folder
    fixed = ("+strategy=clear", f"fit.device={request.device}", f"hydra.run.dir={out}")
    return Step(name, (sys.executable, "-m", "clear_strategies.run", *fixed, *overrides), why_not, learn=lambda: folder)


def _again(request: Request) -> list[Step]:
    """The demo twice. Determinism costs nothing that could be switched off: sums have one order, always."""
    overrides = _TINY if request.quick else ("fit.iterations=1000",)
    first, second = (request.out / "checks" / name / "point_cloud.ply" for name in ("once", "twice"))

    def compare() -> str:
        if first.read_bytes() != second.read_bytes():
            raise Unexpected(f"{first} and {second} differ")
        return "the same bits; there is no switch that it would cost"

    once, twice = (_training(request, "train, demo, once", f"checks/{n}", overrides) for n in ("once", "twice"))
    return [once, Step("train, demo, twice: the same bits?", twice.command, learn=compare)]


def _sanitized(request: Request) -> list[Step]:
    """A tiny training under NVIDIA's tools; torch's allocator off, so that each tensor has a border to be crossed."""
    tool = shutil.which("compute-sanitizer")
    why_not = None
    if request.device != "cuda":
        why_not = "it looks at CUDA alone"
    elif tool is None:
        why_not = "compute-sanitizer is not on the PATH; it comes with the CUDA toolkit"
    found = []
    for kind in ("memcheck", "racecheck"):
        run = _training(request, kind, f"checks/{kind}", _TINY).command
        command = (tool or "compute-sanitizer", "--tool", kind, "--error-exitcode", "9", *run)
        found.append(Step(f"compute-sanitizer {kind}", command, why_not, {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}))
    return found


def _environment(request: Request) -> dict[str, str]:
    """This process's, with the package found from anywhere; a rehearsal sees no GPU, even where there is one."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    hidden = {"CUDA_VISIBLE_DEVICES": ""} if request.device == "cpu" else {}
    return {**os.environ, "PYTHONPATH": paths, **hidden}


def _summary(outcomes: Sequence[Outcome]) -> Section:
    columns = {
        "step": [outcome.name for outcome in outcomes],
        "result": [outcome.result for outcome in outcomes],
        "seconds": [number(outcome.seconds) if outcome.result != SKIPPED else "–" for outcome in outcomes],
        "log": [outcome.log or "–" for outcome in outcomes],
        "says": [outcome.says or "–" for outcome in outcomes],
    }
    return Section("What a device shows", columns)


def _stages(out: Path) -> list[Section]:
    """Seconds by stage of each training that is there."""
    sections = []
    for file in sorted((out / "runs").glob("*/timing.csv")):
        with file.open(encoding="utf-8", newline="") as opened:
            rows = list(csv.DictReader(opened))
        columns = {name: [row[name] for row in rows] for name in ("stage", "runs", "ms_each", "seconds", "skipped")}
        sections.append(Section(f"{file.parent.name}: seconds by stage", columns))
    return sections


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else "it said nothing"


def _slug(name: str) -> str:
    return "_".join("".join(c if c.isalnum() else " " for c in name.lower()).split())
