"""Scaling of time and memory: of an iteration with Gaussians and with pixels, of a whole run with photos.

The exponent p of a row is that of time ~ size^p from the row before: 1 is linear. Each row is a process of its own, and MiB is
its peak. Photos are those of the demo; the time of a run of them is CPU time.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing import get_context
from typing import Any, Final

import numpy as np
import pandas as pd
import torch

import rasterizers
from clear_strategies import run
from clear_strategies.bench import scenes
from clear_strategies.bench.iteration import TOTAL, Training, view_of
from clear_strategies.bench.results import Results, interleaved, medians
from clear_strategies.compose import quoted
from clear_strategies.core.work_log import peak_mib
from clear_strategies.errors import DataError
from clear_strategies.merging.objective import Objective
from clear_strategies.training.loop import kernel_threads

_WIDTH, _GAUSSIANS = 504, 100_000  # the constant size while the other varies
_RUN: Final = ("data.reader.width=128", "data.reader.height=96")


def measure(
    results: Results, *, gaussians: Sequence[int], widths: Sequence[int], photos: Sequence[int], iterations: int, repeats: int
) -> None:  # fmt: skip
    """Measure each size.

    Args:
        widths: of HR images of 4:3, px, multiples of 12.
        photos: numbers of training photos of a run of `iterations`.
    """
    if wrong := [width for width in widths if width % 12]:
        raise DataError("--widths", str(wrong[0]), "is no multiple of 12", "use one, such as 504")
    sizes = [("Gaussians", n, n, _WIDTH) for n in sorted(gaussians)]
    sizes += [("pixels", w * w * 3 // 4, _GAUSSIANS, w) for w in sorted(widths)]
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as one:
        rows = [one.submit(_iteration, *size, repeats, torch.get_num_threads()).result() for size in sizes]
        rows += [row for n in sorted(photos) for row in _run(one, n, iterations)]
    table = pd.DataFrame(rows, columns=["of", "size", "ms", "mib"])
    steps = np.log(table[["ms", "size"]].astype(float)).groupby(table["of"], sort=False).diff()
    table["exponent"] = steps["ms"] / steps["size"]
    results.tables["scale"] = table
    size = f"{_WIDTH}x{_WIDTH * 3 // 4}"
    results.note(
        f"An iteration with Gaussians at HR {size}, with pixels at {_GAUSSIANS:,} Gaussians; a run of {iterations} iterations."
    )


def _iteration(of: str, size: int, gaussians: int, width: int, repeats: int, threads: int) -> tuple[Any, ...]:
    torch.set_num_threads(threads)
    # Gaussians shrink as their number grows, as in the generated scenes.
    radius = 5.5 * width / 1008 * (gaussians / 100_000) ** -0.3
    workload = scenes.surfaces(f"{of} {size:,}", gaussians, width, width * 3 // 4, radius=radius)
    rasterizer = rasterizers.load(rasterizers.fastest("cpu"), preset="fast", **scenes.SETTINGS)
    training = Training(workload, view_of(workload, rasterizer), rasterizer, Objective())
    with kernel_threads(training.state, rasterizer):
        turns = interleaved({of: training}, repeats, device="cpu", label=workload.name)
    return of, size, medians(turns).loc[of, TOTAL], peak_mib()


def _run(one: ProcessPoolExecutor, photos: int, iterations: int) -> list[tuple[Any, ...]]:
    """A row for the whole run, and one for each of its stages, from timing.csv, whose times are wall-clock."""
    with tempfile.TemporaryDirectory() as folder:
        counts = (f"data.reader.views={photos + 1}", f"data.reader.train={photos}", f"fit.iterations={iterations}")
        words = [*_RUN, *counts, f"hydra.run.dir={quoted(f'{folder}/run')}"]
        code, seconds = one.submit(_trained, words).result()
        if code:
            problem = f"its run ended with code {code}"
            raise DataError("--photos", str(photos), problem, " ".join(["python -m clear_strategies.run", *words[:-1]]))
        stages = pd.read_csv(f"{folder}/run/timing.csv").query("seconds > 0")
    peak = int(stages["peak_mib"].max())
    rows: list[tuple[Any, ...]] = [("photos", photos, 1e3 * seconds, peak)]
    return rows + [(s.stage, photos, 1e3 * s.seconds, s.peak_mib) for s in stages.itertuples()]


def _trained(words: Sequence[str]) -> tuple[Any, float]:
    """The exit code of a run in this process, and the process's CPU time, seconds."""
    sys.argv[1:] = words
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):  # noqa: PTH123
        try:
            run.main()
        except SystemExit as ended:
            return ended.code, time.process_time()
    return 0, time.process_time()
