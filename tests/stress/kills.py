"""A real run is killed at random moments, started again, and killed again; at its end it has the bits of one that never was.

A run is forked off a process that has already imported everything, so that a kill costs a fraction of a second.
"""

import random
import time
from pathlib import Path

from clear_strategies.errors import DataError
from clear_strategies.jobs.resume import CHECKPOINTS
from clear_strategies.training import checkpoint
from tests.helpers.command_line import TINY, started
from tests.helpers.forked import Forked
from tests.stress.rows import Row, Worst

# Every event of a run and a checkpoint every third iteration.
_RUN = [
    *(override for override in TINY if not override.startswith("fit.iterations")),
    "+strategy=clear", "fit.iterations=60", "fit.checkpoint_every=500", "fit.keep=2", "fit.video=0", "fit.map_views=0",
    "fit.resume=auto", "fit.threads=1", "density.max_gaussians=300",
]  # fmt: skip
_MOST_KILLS = 6  # of one run, before it may end


def measure(folder: Path, kills: int) -> Row:
    """Kill runs `kills` times in all; a failure is a checkpoint lost, a rest after the end, or another result."""
    _require_done(_started(folder / "warm"))  # the process that forks imports meanwhile
    began = time.monotonic()
    _require_done(_started(folder / "whole"))
    seconds = time.monotonic() - began
    expected, rng, failures, run = _results(folder / "whole"), random.Random(0), Worst(), 0  # noqa: S311 - no secret
    while failures.cases < kills:
        run_folder, newest, run = folder / f"run{run}", 0, run + 1
        for _ in range(min(rng.randint(1, _MOST_KILLS), kills - failures.cases)):
            delay = rng.uniform(0, seconds)
            process = _started(run_folder)
            time.sleep(delay)
            process.kill()
            process.wait()
            t = _newest(run_folder)
            failures.add(float(t is None or t < newest), f"run {run}, killed after {delay:.2f} s: a checkpoint is lost")
            newest = t or newest
        _require_done(_started(run_folder))
        same, rests = _results(run_folder) == expected, _rests(run_folder)
        failures.add_to_last(
            float(not same or bool(rests)), f"run {run}: {'another result' if not same else f'left {rests}'}"
        )
    return failures.row(
        "SIGKILLs of a run: a checkpoint lost, a rest after the next start, or another result", "cpu", 0
    )


def _started(folder: Path) -> Forked:
    where = f"hydra.run.dir={folder.name}"
    return started("-m", "clear_strategies.run", *_RUN, where, cwd=folder.parent, said=folder.with_suffix(".said"))


def _require_done(process: Forked) -> None:
    if code := process.wait():
        raise RuntimeError(f"the run that nobody killed ended with {code}")


def _newest(folder: Path) -> int | None:
    """The iteration of the newest checkpoint, 0 where none was saved yet; None where one is not whole."""
    try:
        return max((checkpoint.load(path).t for path in checkpoint.saved(folder / CHECKPOINTS)), default=0)
    except DataError:
        return None


def _results(folder: Path) -> tuple[bytes, dict[str, bytes]]:
    """The bytes of the exported field, and of every tensor of the last checkpoint."""
    tensors = checkpoint.load(folder).tensors
    return (folder / "point_cloud.ply").read_bytes(), {name: x.numpy().tobytes() for name, x in tensors.items()}


def _rests(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*") if ".partial" in path.name)
