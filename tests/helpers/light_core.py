"""The core without the trainer's libraries, as a host has it: run in an environment where only the wheel is installed.

Imports what a host imports, composes a conductor, takes three steps of a loop that merges by GCO alone, and finds the depth
of a plane by stereo.
"""

import importlib.util
import subprocess
import sys

import torch

import integration.gsplat
import rasterizers
from clear_strategies import GCO, Conductor, Grads
from clear_strategies.compose import conductor
from clear_strategies.geometry import stereo

TRAINERS = ("cv2", "kornia", "skimage", "matplotlib", "msgspec", "scipy", "open3d", "safetensors", "tqdm")


def main() -> None:
    installed = [name for name in TRAINERS if importlib.util.find_spec(name) is not None]
    assert not installed, f"the core brings {', '.join(installed)}"
    assert [type(s).__name__ for s in conductor("clear", iterations=30_000).strategies] == ["GCO", "P2G", "SVS"]
    assert integration.gsplat.attach is not None
    assert "torch" in rasterizers.available()
    ours = Conductor(GCO())
    means = torch.zeros(8, 3)
    for t in range(1, 4):
        lr, hr = (Grads({"means": torch.randn(8, 3, generator=torch.Generator().manual_seed(t + k))}) for k in (0, 9))
        corrected = ours.strategies[0].correct(lr, hr, None)
        means -= 0.1 * (lr["means"] + corrected["means"])
    assert bool(means.isfinite().all())
    require_stereo()
    command = [sys.executable, "-m", "clear_strategies.run", "+strategy=clear"]
    door = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (door.returncode, door.stderr.count("\n")) == (2, 1), door.stdout + door.stderr
    assert "pip install 'clear-strategies[train]'" in door.stderr


def require_stereo() -> None:
    """Two photos of a plane at z = 4, from places 0.4 apart with f = 100 px: one is the other, moved by 10 px."""
    grey = torch.rand(1, 3, 24, 40, generator=torch.Generator().manual_seed(0))
    wide = torch.nn.functional.interpolate(grey, size=(48, 80), mode="bicubic")[0].clamp(0, 1).permute(1, 2, 0)
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = -0.4
    K = torch.tensor([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    found = stereo([wide[:, :64], wide[:, 10:74]], poses, K.repeat(2, 1, 1))
    off = (found.means[:, 2] / 4 - 1).abs()
    assert len(found.means) >= 500, found.summary
    assert float((off < 0.03).float().mean()) >= 0.9, found.summary
    assert "without scipy" in found.summary


if __name__ == "__main__":
    main()
