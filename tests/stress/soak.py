"""A long run in one process, with every event: memory and open files stay flat, and no number becomes NaN."""

import gc
import math
import multiprocessing
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import psutil
import torch

from clear_strategies import GCO, P2G, SVS, Conductor, Objective
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.schedules import scaled
from clear_strategies.training import checkpoint
from clear_strategies.training.evaluation import evaluate
from clear_strategies.training.loop import iterate
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers import BackendUnavailable, load
from tests.helpers import toy
from tests.stress.rows import Row

_GROWTH = 0.01  # of the resident memory, after the first fifth of the run


def measure(iterations: int) -> list[Row]:
    """In a process of its own, whose memory nothing else changes."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(run, iterations).result()


def run(iterations: int) -> list[Row]:
    """The milestones of 10,000 iterations, stretched to `iterations`: the structure changes in the first half."""
    torch.set_num_threads(1)
    scene, stretch = toy.scene(60, train=4), iterations / 10_000
    try:
        rasterizer, backend = load("cpp"), "cpp"
    except BackendUnavailable:
        rasterizer, backend = toy.RASTERIZER, "torch"
    svs = scaled(SVS(anchor_strength=0.01), stretch)
    state = TrainState.start(
        scene, Conductor(GCO(), P2G(), svs, objective=scaled(Objective(), stretch)),
        settings=scaled(FitSettings(iterations=iterations), stretch),
        density=scaled(DensitySettings(max_gaussians=400, threshold=1e-4), stretch),
        rates=scaled(LearningRates(), stretch), mip=scaled(MipFilter(), stretch),
    )  # fmt: skip
    resident, files, bad = [], [], 0
    with tempfile.TemporaryDirectory() as folder:
        for t in range(1, iterations + 1):
            iterate(state, rasterizer)
            bad += not all(math.isfinite(float(x)) for name, x in state.history[-1].items() if name.startswith("loss"))
            if t % max(10, iterations // 40) == 0:
                evaluate(state, scene, rasterizer, t)
                checkpoint.save(Path(folder), state.checkpoint({}))
                gc.collect()
                resident.append(psutil.Process().memory_info().rss)
                files.append(len(os.listdir("/proc/self/fd")))  # noqa: PTH208
    settled = len(resident) // 5
    before, after = resident[settled - 1], max(resident[settled:])
    where = f"{before >> 20} MiB after {iterations // 5:,}, {after >> 20} MiB at most since"
    more = float(max(files[settled:]) - files[settled - 1])
    measured = {
        "growth of the memory after a fifth of the run": (after / before - 1, _GROWTH, where),
        "open files more than after a fifth of the run": (more, 0, f"{files[-1]} open"),
        "iterations with a loss that is not finite": (float(bad), 0, "none"),
    }
    return [Row(f"soak: {what}", backend, iterations, *numbers) for what, numbers in measured.items()]
