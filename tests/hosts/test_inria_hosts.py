"""The real train.py of 3DGS and of its forks, on a CPU: from the start through densification, evaluation, save and reload.

    CLEAR_HOSTS=FOLDER python -m pytest tests/hosts

FOLDER holds checkouts named 3dgs, mip-splatting, dropgaussian, fsgs; nothing is fetched, and those that are not there are
skipped. Their CUDA modules are replaced by tests/hosts/cpu. plyfile, torchmetrics and matplotlib must be installed.
"""

from __future__ import annotations

import re

import pytest

from clear_strategies.data.ply import read_gaussians
from tests.helpers.real_hosts import FROM_START, checkout, run

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
SETUP = "    gaussians.training_setup(opt)\n"


@pytest.fixture(params=HOSTS)
def host(request):
    return checkout(request.param, "train.py")


def training(host, **more):
    """The trainer's options."""
    return [*HOSTS[host.name], "--eval", *(f"--{name}={value}" for name, value in (TRAINING | more).items())]


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
