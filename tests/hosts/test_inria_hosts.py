"""The real train.py of 3DGS and of its forks, on a CPU: from the start through densification, evaluation, save and reload,
and the options that touch what CLEAR draws.

    CLEAR_HOSTS=FOLDER python -m pytest tests/hosts

FOLDER holds checkouts named 3dgs, mip-splatting, dropgaussian, fsgs; nothing is fetched, and those that are not there are
skipped. open3d, plyfile, torchmetrics, torchvision and matplotlib must be installed.
"""

import re

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.data.ply import read_gaussians
from tests.helpers.real_hosts import checkout, clear, counts, hide_half, run, spoil_half, stereo_points

HOSTS = {
    "3dgs": ["--disable_viewer"],
    "mip-splatting": [],
    "dropgaussian": ["-r=1", "--n_views=3"],
    "fsgs": ["-r=1", "--n_views=3", "--images=images", "--start_sample_pseudo=10", "--sample_pseudo_interval=5"],
}
TRAINING = {
    "iterations": 30, "densify_from_iter": 5, "densification_interval": 5, "densify_until_iter": 25, "test_iterations": 30,
    "checkpoint_iterations": 20, "densify_grad_threshold": 1e-5,
}  # fmt: skip


@pytest.fixture(params=HOSTS)
def host(request):
    return checkout(request.param, "train.py")


def training(host, **more):
    """The trainer's options."""
    return [
        *HOSTS[host.name], "--eval", "--port=0", *(f"--{name}={value}" for name, value in (TRAINING | more).items()),
    ]  # fmt: skip


def launched(host, scene, model, *extra, points="own", status=0, **more):
    options = training(host, **more)
    return run(host, *clear(scene, points), "train.py", "-s", scene, "-m", model, *options, *extra, status=status)


def cloud(model):
    return read_gaussians(model / "point_cloud" / "iteration_30" / "point_cloud.ply")


def test_it_trains_densifies_evaluates_saves_and_continues(host, scene, tmp_path):
    said = launched(host, scene, tmp_path / "whole")
    assert "densify_until_iter=16 instead of 25" in said  # read from the host's own options
    assert counts(said)["merges"] == counts(said)["HR renders"] == 30
    assert counts(said)["structure changes"] >= 1
    assert "Evaluating test" in said
    whole = cloud(tmp_path / "whole")
    assert len(whole) != 60
    resumed = launched(host, scene, tmp_path / "resumed", start_checkpoint=tmp_path / "whole" / "chkpnt20.pth")
    assert "10 merges" in resumed or "11 merges" in resumed  # FSGS writes its checkpoint before the step
    assert len(cloud(tmp_path / "resumed")) == len(whole)


def test_it_trains_alone(host, scene, tmp_path):
    """Without strategies."""
    said = run(host, "train.py", "-s", scene, "-m", tmp_path / "model", *training(host))
    assert "Evaluating test" in said
    assert "merges" not in said
    assert len(cloud(tmp_path / "model")) >= 60


def test_it_starts_from_stereo_between_its_photos(host, scene, tmp_path):
    said = launched(host, scene, tmp_path / "model", points="stereo", densify_until_iter=0)
    assert f"Number of points at initialisation :  {stereo_points(said)}" in said
    assert "30 merges" in said
    assert len(cloud(tmp_path / "model")) == stereo_points(said)


def test_its_own_render_py_shows_what_training_evaluated(host, scene, tmp_path):
    """The file holds f_base + f_det, as evaluation during training shows it."""
    said = launched(host, scene, tmp_path / "model")
    (evaluated,) = (float(psnr) for psnr in re.findall(r"Evaluating test: .*PSNR (?:tensor\()?([\d.]+)", said))
    run(host, "render.py", "-m", tmp_path / "model", "--skip_train")
    files = sorted((tmp_path / "model" / "test").rglob("*.png"))
    assert len(files) == 2  # the rendering and the photo
    rendered, photo = (np.asarray(Image.open(file), dtype=float) / 255 for file in files)
    squared = ((rendered - photo) ** 2).mean((0, 1))
    assert float((-10 * np.log10(squared)).mean()) == pytest.approx(evaluated, abs=0.05)


@pytest.mark.parametrize("hidden_by", ["alpha of the photos", "--train_test_exp"])
def test_what_3dgs_hides_is_learned_from_no_sr_image(hidden_by, scene, tmp_path):
    host, extra = checkout("3dgs", "train.py"), []
    if hidden_by == "--train_test_exp":
        extra, names = [hidden_by], ["a0.png"]  # the right half of the test photo
    else:
        hide_half(scene / "images")
        names = ["b1.png", "b2.png", "b3.png"]
    launched(host, scene, tmp_path / "whole", *extra)
    spoil_half(scene / "sr", *names)
    launched(host, scene, tmp_path / "spoilt", *extra)
    whole, spoilt = cloud(tmp_path / "whole"), cloud(tmp_path / "spoilt")
    assert all(torch.equal(getattr(whole, name), getattr(spoilt, name)) for name in ("means", "opacities", "sh0"))
