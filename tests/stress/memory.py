"""The peak of memory that the plan predicts for training, against the one that training reaches."""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest import mock

import torch

from clear_strategies.jobs import job
from clear_strategies.training import memory
from clear_strategies.training.state import TrainState
from tests.helpers.command_line import TINY
from tests.helpers.configs import composed
from tests.stress.rows import Row

_BOUND = 0.15
_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
_ALL = ["+strategy=clear", "fit.baseline=false", "fit.video=0", "fit.map_views=0", "fit.iterations=60", "fit.threads=1",
        "fit.probe_every=0"]  # fmt: skip
SCENES = {
    "demo": [*_ALL],
    "fern": [*_ALL, "+scene=fern", f"data.root={_DATA}"],
    "kitchen360": [*_ALL, "+scene=kitchen360", f"data.root={_DATA}"],
}


def measure() -> Iterator[Row]:
    """One row per scene that is here, each in a process of its own."""
    for name, overrides in SCENES.items():
        if name != "demo" and not (_DATA / name).is_dir():
            continue
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            predicted, reached, loading, gaussians = pool.submit(run, overrides).result()
        where = (
            f"predicted {predicted:.0f} MiB for {gaussians:,} Gaussians, taken {reached:.0f}, {loading:.0f} before it"
        )
        yield Row("predicted peak of memory: relative error", name, 1, abs(predicted / reached - 1), _BOUND, where)


def run(overrides: Sequence[str]) -> tuple[float, float, float, int]:
    """MiB beyond the imports: predicted and reached while training, at the largest number of Gaussians, and held before the first
    iteration; and that number. What loading took at its peak, which the plan measures, is left out.
    """
    torch.set_num_threads(1)
    folder = Path(tempfile.mkdtemp())
    job.run(composed(*TINY, "+strategy=clear", "fit.video=0"), folder / "imports")
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    base, gaussians, peak, plans = memory.resident(), 0, 0, list[memory.Needs]()
    needs, fit = memory.needs, job.fit

    def noted(state: TrainState, rasterizer) -> memory.Needs:
        plans.append(needs(state, rasterizer))
        return plans[-1]

    def watched(state: TrainState, *arguments, progress, **options) -> TrainState:
        nonlocal peak

        def counted(state: TrainState) -> None:
            nonlocal gaussians
            gaussians = max(gaussians, len(state.field))
            progress(state)

        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
        ended = fit(state, *arguments, progress=counted, **options)
        peak = memory.peak()
        return ended

    with mock.patch.object(memory, "needs", noted), mock.patch.object(job, "fit", watched):
        job.run(composed(*overrides), folder / "run")
    plan = plans[0]
    predicted = replace(plan, reached=0).peak(gaussians)
    return *((size - base) / 2**20 for size in (predicted, peak, plan.now)), gaussians
