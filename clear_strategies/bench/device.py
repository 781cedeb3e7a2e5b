"""All checks that need a GPU: tests, tables, whole trainings, determinism, compute-sanitizer.

Each step is a command in a process of its own with a log of its own; a step that fails stops no
other. With `--device cpu --quick` the same program runs tiny scenes without a GPU.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import pandas as pd

from clear_strategies.bench.rasterizers import require_device
from clear_strategies.bench.results import ROOT, Results, environment
from clear_strategies.errors import DataError

PASSED, FAILED, SKIPPED = "passed", "failed", "not run"

TINY: Final = (
    "data.reader.width=64", "data.reader.height=48", "data.reader.views=5", "data.reader.train=2", "data.views.train=2",
    "data.cloud.init=random", "data.cloud.random_points=60", "fit.iterations=12", "fit.max_degree=1",
)  # fmt: skip
_FERN: Final = {"images_4": "HR 1008x756", "images_2": "HR 2016x1512"}  # LLFF's folders of the HR photos


@dataclass(frozen=True, slots=True)
class Request:
    """The options of the command line."""

    out: Path
    device: str
    quick: bool = False
    data_root: Path | None = None
    data: Path | None = None
    scene: Sequence[Path] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A command to run.

    Args:
        why_not: why it cannot run here.
        problem: called after success; what is wrong with the files it wrote, if anything.
    """

    name: str
    command: Sequence[str]
    why_not: str | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    problem: Callable[[], str | None] = lambda: None


def measure(results: Results, request: Request, plan: Callable[[Request], Sequence[Step]] | None = None) -> None:
    """Run all steps.

    Args:
        plan: the steps of a request; `steps` unless given.

    Raises:
        DataError: there is no such device, or the folder is not empty.
    """
    require_device(request.device)
    if request.out.exists() and (not request.out.is_dir() or any(request.out.iterdir())):
        raise DataError("--out", str(request.out), "must be a new folder, or an empty one", "name another")
    (request.out / "logs").mkdir(parents=True)
    rows = []
    for nth, step in enumerate((plan or steps)(request), 1):
        results.log(f"{step.name} ...")
        name = "_".join("".join(c if c.isalnum() else " " for c in step.name.lower()).split())
        rows.append(_run(step, request, request.out / "logs" / f"{nth:02}_{name}.log"))
        results.log(f"{step.name}: {rows[-1]['result']} {rows[-1]['reason']}".strip())
    results.tables["device"] = pd.DataFrame(rows)
    results.failed = any(row["result"] == FAILED for row in rows)


def steps(request: Request) -> list[Step]:
    """The steps in their order."""
    return [_tests(request), *_tables(request), *_trainings(request), *_checks(request)]


def _run(step: Step, request: Request, log: Path) -> dict[str, Any]:
    row = {"step": step.name, "result": SKIPPED, "seconds": 0.0, "reason": step.why_not or "", "log": ""}
    if step.why_not is not None:
        return row
    hidden = {"CUDA_VISIBLE_DEVICES": ""} if request.device == "cpu" else {}
    began = time.perf_counter()
    with log.open("wb") as output:
        try:
            code = subprocess.run(  # noqa: S603 - our own programs, and NVIDIA's
                step.command, env=environment(**hidden, **step.environment), stdout=output, stderr=subprocess.STDOUT,
                check=False,
            ).returncode  # fmt: skip
            last_line = (log.read_text("utf-8", "replace").strip().splitlines() or ["it printed nothing"])[-1]
            problem = step.problem() if code == 0 else f"exit code {code}: {last_line[:200]}"
        except OSError as error:
            problem = str(error)
    seconds, result = round(time.perf_counter() - began, 1), PASSED if problem is None else FAILED
    return row | {"result": result, "seconds": seconds, "reason": problem or "", "log": f"logs/{log.name}"}


def _tests(request: Request) -> Step:
    """Both tiers; `-rs` logs which tests did not run, and why."""
    tests = ROOT / "tests"
    why_not = None if tests.is_dir() else "the tests are in a checkout, not in an installed package"
    which = tests / "test_floors.py" if request.quick else tests
    command = (sys.executable, "-m", "pytest", "-q", "-rs", "-m", "", "-p", "no:cacheprovider", str(which))
    return Step("tests", command, why_not)


def _table(request: Request, name: str, *arguments: str, why_not: str | None = None) -> Step:
    question, out = name.partition("_")[0], request.out / "tables" / name
    command = (sys.executable, "-m", "clear_strategies.bench", question, "--device", request.device, *arguments)
    return Step(f"bench {name}", (*command, "--out", str(out)), why_not)


def _tables(request: Request) -> list[Step]:
    given = [str(path) for path in request.scene]
    if request.quick:
        once = ("--repeats", "1")
        return [
            _table(request, "rasterizers", "--scene", "tiny", *given, "--preset", "fast", *once),
            _table(request, "kernels", "--size", "32x16", "--gaussians", "500", *once),
            _table(request, "iteration", "--scene", "tiny", *once),
        ]
    garden = ("garden", "--data", str(request.data)) if request.data is not None else ()
    return [
        _table(request, "rasterizers", "--scene", "s100k", "s100k-lr", "s500k", *given, *garden),
        _table(request, "kernels", "--size", "1008x756", "252x189", "2016x1512", "504x378"),
        _table(request, "iteration_1008", "--scene", "s100k"),
        _table(request, "iteration_2016", "--scene", "s300k-2016"),
    ]


def _trainings(request: Request) -> list[Step]:
    """CLEAR on fern with and without skips, then tables of the trained field."""
    if request.quick:
        trainings, folder, missing = [_training(request, "train, demo", "runs/demo", TINY)], "demo", None
    else:
        trainings, folder, missing = [], "fern_images_4", _missing(request, "images_4")
        for photos, size in _FERN.items():
            reader = (
                "+scene=fern",
                f"data.root={request.data_root}",
                f"data.reader.images={photos}",
                "data.views.shrink=1",
            )
            for suffix, skips in (("", ("skips=none",)), ("_skips", ())):
                run, name = f"runs/fern_{photos}{suffix}", f"train, fern {size}{', default skips' * bool(suffix)}"
                overrides = (*reader, "fit.iterations=10000", *skips)
                trainings.append(_training(request, name, run, overrides, why_not=_missing(request, photos)))
    ply, few = str(request.out / "runs" / folder / "point_cloud.ply"), ("--repeats", "1") if request.quick else ()
    preset = ("--preset", "fast") if request.quick else ()
    return [
        *trainings,
        _table(request, "rasterizers_trained", "--scene", ply, *few, *preset, why_not=missing),
        _table(request, "iteration_trained", "--scene", ply, *few, why_not=missing),
    ]


def _missing(request: Request, photos: str) -> str | None:
    if request.data_root is None:
        return "give the folder that holds fern with --data-root"
    folder = request.data_root / "fern" / photos
    return None if folder.is_dir() else f"{folder} is not there"


def _training(request: Request, name: str, folder: str, overrides: Sequence[str], **options: Any) -> Step:
    fixed = (
        "+strategy=clear",
        "fit.baseline=false",
        f"fit.device={request.device}",
        f"hydra.run.dir={request.out / folder}",
    )
    return Step(name, (sys.executable, "-m", "clear_strategies.run", *fixed, *overrides), **options)


def _checks(request: Request) -> list[Step]:
    """First use with and without compiled kernels in the cache, determinism, compute-sanitizer."""
    needs_cuda = None if request.device == "cuda" else "it needs CUDA"
    cache = {"WARP_CACHE_PATH": str(request.out / "warp_cache")}
    first_use = [
        _training(request, f"first use, {state} cache", f"checks/{state}", TINY, why_not=needs_cuda, environment=cache)
        for state in ("empty", "filled")
    ]
    overrides = TINY if request.quick else ("fit.iterations=1000",)
    first, second = (request.out / "checks" / name / "point_cloud.ply" for name in ("once", "twice"))

    def differ() -> str | None:
        return None if first.read_bytes() == second.read_bytes() else f"{first} and {second} differ"

    once = _training(request, "train, demo, once", "checks/once", overrides)
    twice = _training(request, "train, demo, twice: same bits", "checks/twice", overrides, problem=differ)

    tool = shutil.which("compute-sanitizer")
    missing = None if tool else "compute-sanitizer is not on the PATH; it comes with the CUDA toolkit"
    # Without torch's caching allocator each tensor has bounds of its own.
    uncached = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    sanitized = []
    for kind in ("memcheck", "racecheck"):
        training = _training(request, f"compute-sanitizer {kind}", f"checks/{kind}", TINY, environment=uncached)
        command = (tool or "compute-sanitizer", "--tool", kind, "--error-exitcode", "9", *training.command)
        sanitized.append(replace(training, command=command, why_not=needs_cuda or missing))
    return [*first_use, once, twice, *sanitized]
