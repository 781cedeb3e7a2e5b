"""The real train.py of 3DGS and of its forks, on a CPU: from the start through densification, evaluation, save and reload.

    CLEAR_HOSTS=FOLDER python -m pytest tests/hosts

FOLDER holds checkouts named 3dgs, mip-splatting, dropgaussian, fsgs; nothing is fetched, and those that are not there are
skipped. Their CUDA modules are replaced by tests/hosts/cpu. plyfile, torchmetrics and matplotlib must be installed.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from clear_strategies.core import images
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import read_gaussians
from tests.helpers import toy

ROOT = Path(__file__).resolve().parents[2]
CPU = Path(__file__).parent / "cpu"
HOSTS = {
    "3dgs": ["--disable_viewer"],
    "mip-splatting": [],
    "dropgaussian": ["-r", "1", "--n_views", "3"],
    "fsgs": [
        "-r",
        "1",
        "--n_views",
        "3",
        "--images",
        "images",
        "--start_sample_pseudo",
        "10",
        "--sample_pseudo_interval",
        "5",
    ],
}
TRAINING = {
    "iterations": 30, "densify_from_iter": 5, "densification_interval": 5, "densify_until_iter": 25, "test_iterations": 30,
    "checkpoint_iterations": 20, "densify_grad_threshold": 1e-5,
}  # fmt: skip
FROM_START = ["objective.lambda_hr.start=0", "objective.lambda_hr.full=0", "strategies.p2g.patch=4"]
SETUP = "    gaussians.training_setup(opt)\n"


@pytest.fixture(params=HOSTS)
def host(request):
    folder = Path(os.environ.get("CLEAR_HOSTS", "")) / request.param
    if "CLEAR_HOSTS" not in os.environ or not (folder / "train.py").is_file():
        pytest.skip(f"needs a checkout of {request.param} in CLEAR_HOSTS")
    return folder.resolve()


@pytest.fixture
def scene(tmp_path):
    """The toy scene as COLMAP text; the test view is the first, as the trainers' rule of every eighth photo wants it."""
    made = toy.scene(60)
    c = made.train[0].lr.camera
    lines = []
    for i, view in enumerate([made.test[0], *made.train]):
        name, pose = f"{'ab'[i > 0]}{i}.png", view.lr.camera.world_to_camera
        half = np.arctan2(float(pose[0, 2]), float(pose[0, 0])) / 2  # the toy's cameras turn about y
        numbers = (np.cos(half), 0, np.sin(half), 0, *pose[:3, 3].tolist())
        lines += [f"{i + 1} {' '.join(map(str, numbers))} 1 {name}", ""]
        write_png(tmp_path / "images" / name, images.quantize(view.lr.image))
        write_png(tmp_path / "sr" / name, images.quantize(view.hr.image))
    points = list(zip(made.cloud.means.tolist(), (made.cloud.colors * 255).int().tolist(), strict=True))
    sparse, dense = tmp_path / "sparse" / "0", tmp_path / "3_views" / "dense"
    for folder in (sparse, dense):
        folder.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}\n")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "test.txt").write_text("a0.png\n")
    rows = [f"{i} {words(x)} {words(rgb)} 0" for i, (x, rgb) in enumerate(points)]
    (sparse / "points3D.txt").write_text("\n".join(rows) + "\n")
    properties = [f"property float {n}" for n in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"property uchar {n}" for n in ("red", "green", "blue")]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *properties, "end_header"]
    body = [f"{words(x)} 0 0 0 {words(rgb)}" for x, rgb in points]
    (dense / "fused.ply").write_text("\n".join([*header, *body]) + "\n")
    np.save(tmp_path / "poses_bounds.npy", np.tile([*[0.0] * 15, 2.0, 6.0], (4, 1)))
    return tmp_path


def words(values):
    return " ".join(map(str, values))


def training(host, **more):
    """The trainer's options."""
    return [*HOSTS[host.name], "--eval", *(f"--{name}={value}" for name, value in (TRAINING | more).items())]


def run(host, *command):
    """The output of a Python program in the host's folder; the exit status must be 0."""
    environment = {
        **os.environ, "HOST": host.name, "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(CPU), str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=host, env=environment, capture_output=True, text=True, timeout=1_800,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2_000:] + done.stderr[-4_000:]
    return done.stdout + done.stderr


def launched(host, scene, model, **more):
    overrides = [f"--overrides={override}" for override in FROM_START]
    clear = ["-m", "integration.inria", "--sr", scene / "sr", *overrides]
    return run(host, *clear, "train.py", "-s", scene, "-m", model, *training(host, **more))


def cloud(model):
    return read_gaussians(model / "point_cloud" / "iteration_30" / "point_cloud.ply")


def test_it_trains_densifies_evaluates_saves_and_continues(host, scene, tmp_path):
    said = launched(host, scene, tmp_path / "whole")
    assert "densify_until_iter=15 instead of 25" in said  # read from the host's own options
    counts = {what: int(n) for n, what in re.findall(r"(\d+) (merges|HR renders|structure changes)", said)}
    assert counts["merges"] == counts["HR renders"] == 30
    assert counts["structure changes"] >= 1
    assert "Evaluating test" in said
    whole = cloud(tmp_path / "whole")
    assert len(whole) != 60
    resumed = launched(host, scene, tmp_path / "resumed", start_checkpoint=tmp_path / "whole" / "chkpnt20.pth")
    assert "10 merges" in resumed or "11 merges" in resumed  # FSGS writes its checkpoint before the step
    assert len(cloud(tmp_path / "resumed")) == len(whole)


def test_one_line_in_train_py_does_the_same(host, scene, tmp_path):
    text = (host / "train.py").read_text()
    assert text.count(SETUP) == 1
    line = f"    install(gaussians, scene, opt, sr={str(scene / 'sr')!r}, overrides={FROM_START!r})\n"
    paths = f"import sys; sys.path.insert(0, {str(host)!r})\nfrom integration.inria import install\n"
    edited = tmp_path / "edited.py"
    edited.write_text(paths + text.replace(SETUP, SETUP + line))
    run(host, edited, "-s", scene, "-m", tmp_path / "edited", *training(host))
    launched(host, scene, tmp_path / "launched")
    one, none = cloud(tmp_path / "edited"), cloud(tmp_path / "launched")
    assert len(one) == len(none)
    assert float((one.sh0 - none.sh0).abs().max()) < 1e-4
