"""Runs of the command line in processes of their own, tiny ones."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TINY = ["data.reader.width=64", "data.reader.height=48", "fit.iterations=12", "fit.max_degree=1", "data.cloud.init=random",
        "data.cloud.random_points=60", "data.reader.views=5", "data.reader.train=2", "data.views.train=2",
        "skips=none", "fit.baseline=false", "fit.page=0"]  # fmt: skip


def run(
    *arguments: str, cwd: Path, module: str = "clear_strategies.run", **options
) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(ROOT), "CLEAR_CACHE": str(cwd / "cache"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(
        command, cwd=cwd, env=env, capture_output=True, text=True, timeout=240, check=False, **options
    )


def trains(folder: Path) -> bool:
    """Whether a run has come to its first density round, so that it answers signals by saving, until it has trained."""
    log = folder / "run.log"
    return log.exists() and " cloned, " in log.read_text()


def wait_for(condition: Callable[[], bool], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
