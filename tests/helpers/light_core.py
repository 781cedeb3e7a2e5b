"""The core without the trainer's libraries, as a host has it: run in an environment where only the wheel is installed.

Imports what a host imports, composes a conductor, and takes three steps of a loop that merges by GCO alone.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import torch

import integration.gsplat
import rasterizers
from clear_strategies import GCO, Conductor, Grads
from clear_strategies.compose import conductor

TRAINERS = ("cv2", "kornia", "skimage", "matplotlib", "scipy", "open3d", "safetensors", "tqdm")


def main() -> None:
    installed = [name for name in TRAINERS if importlib.util.find_spec(name) is not None]
    if installed:
        raise SystemExit(f"the core brings {', '.join(installed)}")
    if [type(s).__name__ for s in conductor("clear", iterations=30_000).strategies] != ["GCO", "P2G", "SVS"]:
        raise SystemExit("conductor('clear') is something else")
    if integration.gsplat.attach is None or "torch" not in rasterizers.available():
        raise SystemExit("the hosts' functions are not there")
    ours = Conductor(GCO())
    means = torch.zeros(8, 3)
    for t in range(1, 4):
        lr, hr = (Grads({"means": torch.randn(8, 3, generator=torch.Generator().manual_seed(t + k))}) for k in (0, 9))
        corrected = ours.strategies[0].correct(lr, hr, None)
        means -= 0.1 * (lr["means"] + corrected["means"])
    if not bool(means.isfinite().all()):
        raise SystemExit("the loop diverged")
    door = subprocess.run([sys.executable, "-m", "clear_strategies.run"], capture_output=True, text=True, check=False)
    if (
        door.returncode != 2
        or "pip install 'clear-strategies[train]'" not in door.stderr
        or door.stderr.count("\n") != 1
    ):
        raise SystemExit(f"training without [train] says: {door.stdout}{door.stderr}")


if __name__ == "__main__":
    main()
