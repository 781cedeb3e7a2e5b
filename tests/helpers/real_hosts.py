"""Checkouts of real trainers, run as programs on a CPU, and the toy scene in COLMAP's text files for them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.core import images
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import write_points
from tests.helpers import toy
from tests.helpers.host_parts import FROM_START
from tests.helpers.paths import ROOT

HOSTS = ROOT / "tests" / "hosts"


def checkout(name: str, script: str) -> Path:
    """The folder of a trainer; the test is skipped without it."""
    folder = Path(os.environ.get("CLEAR_HOSTS", "")) / name
    if "CLEAR_HOSTS" not in os.environ or not (folder / script).is_file():
        pytest.skip(f"needs a checkout of {name} in CLEAR_HOSTS")
    return folder.resolve()


def run(host: Path, *command: object, inside: str = "", more_paths: tuple[Path, ...] = (), status: int = 0) -> str:
    """The output of `integration.on_cpu` in the host's folder, which must end with this exit status."""
    paths = [HOSTS / "networks", *more_paths, ROOT, os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1",  # the trainers' checkpoints are from before torch 2.6
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "integration.on_cpu", *map(str, command)], cwd=host / inside, env=environment,
        capture_output=True, text=True, timeout=1_800, check=False,
    )  # fmt: skip
    assert done.returncode == status, done.stdout[-2_000:] + done.stderr[-4_000:]
    return done.stdout + done.stderr


def clear(scene: Path, points: str = "own") -> list[object]:
    """The launcher's options for training with the strategies."""
    overrides = [f"--overrides={override}" for override in FROM_START]
    return ["--strategies", "clear", "--points", points, "--sr", scene / "sr", *overrides]


def counts(said: str) -> dict[str, int]:
    """The summary of the work, in what a trainer said."""
    return {what: int(n) for n, what in re.findall(r"(\d+) (merges|HR renders|structure changes)", said)}


def stereo_points(said: str) -> int:
    """How many initial points stereo found."""
    (found,) = re.findall(
        r"points=stereo: ([\d,]+) points in all: [\d,]+ points of dense stereo between the 3 photos", said
    )
    return int(found.replace(",", ""))


def write_scene(folder: Path) -> None:
    """The toy scene as COLMAP text; the test view is the first, as the trainers' rule of every eighth photo wants it."""
    made = toy.scene(60)
    c = made.train[0].lr.camera
    lines = []
    for i, view in enumerate([made.test[0], *made.train]):
        name, pose = f"{'ab'[i > 0]}{i}.png", view.lr.camera.world_to_camera
        half = np.arctan2(float(pose[0, 2]), float(pose[0, 0])) / 2  # the toy's cameras turn about y
        numbers = (np.cos(half), 0, np.sin(half), 0, *pose[:3, 3].tolist())
        lines += [f"{i + 1} {' '.join(map(str, numbers))} 1 {name}", ""]
        write_png(folder / "images" / name, images.quantize(view.lr.image))
        write_png(folder / "sr" / name, images.quantize(view.hr.image))
    points = torch.cat((made.cloud.means, (made.cloud.colors * 255).floor()), 1).tolist()
    sparse, dense = folder / "sparse" / "0", folder / "3_views" / "dense"
    for part in (sparse, dense):
        part.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}\n")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "test.txt").write_text("a0.png\n")
    rows = [f"{i} {x} {y} {z} {r:.0f} {g:.0f} {b:.0f} 0" for i, (x, y, z, r, g, b) in enumerate(points)]
    (sparse / "points3D.txt").write_text("\n".join(rows) + "\n")
    write_points(dense / "fused.ply", made.cloud.means, made.cloud.colors)
    np.save(folder / "poses_bounds.npy", np.tile([*[0.0] * 15, 2.0, 6.0], (4, 1)))


def spoil_half(folder: Path, *names: str) -> None:
    """Fill the right half of these images with other pixels."""
    for file in (folder / name for name in names):
        image = np.array(Image.open(file))
        half = image[:, image.shape[1] // 2 :]
        half[...] = np.random.default_rng(0).integers(0, 256, half.shape)
        Image.fromarray(image).save(file)


def hide_half(folder: Path) -> None:
    """Make the right half of all photos transparent."""
    for file in sorted(folder.iterdir()):
        image = np.array(Image.open(file).convert("RGBA"))
        image[:, image.shape[1] // 2 :, 3] = 0
        Image.fromarray(image).save(file)
