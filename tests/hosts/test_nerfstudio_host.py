"""nerfstudio's own programs, on a CPU: splatfacto alone and clear-splatfacto, their evaluation, and the PLY file.

Skipped where nerfstudio is not installed. Its export needs pymeshlab, too.
"""

import importlib.util
import json
import re
import sys
from pathlib import Path

import pytest

from clear_strategies.data.ply import read_gaussians
from tests.helpers.real_hosts import counts, run

if importlib.util.find_spec("nerfstudio") is None:
    pytest.skip("nerfstudio is not installed: docs/how-to/each-host.md", allow_module_level=True)

PROGRAMS = Path(sys.executable).parent
STEPS = 40
TRAINING = {
    "max-num-iterations": STEPS, "vis": "tensorboard", "steps-per-eval-image": STEPS, "timestamp": "now",
    "pipeline.model.warmup-length": 4, "pipeline.model.refine-every": 5, "pipeline.model.densify-grad-thresh": 1e-5,
}  # fmt: skip
READER = {
    "downscale-factor": 1, "images-path": "images", "colmap-path": "sparse/0", "orientation-method": "none",
    "center-method": "none", "auto-scale-poses": False, "eval-mode": "interval", "eval-interval": 8,
}  # fmt: skip


def words(options):
    return [word for name, value in options.items() for word in (f"--{name}", value)]


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """Where this package is only on the path, its entry point is not found."""
    monkeypatch.setenv("NERFSTUDIO_METHOD_CONFIGS", "clear-splatfacto=integration.nerfstudio:clear_splatfacto")


def trained(scene, folder, method, **more):
    """What the training said, and its configuration."""
    folder.mkdir()
    options = words({"data": scene, "output-dir": folder, "experiment-name": "toy"} | TRAINING | more)
    said = run(folder, PROGRAMS / "ns-train", method, *options, "colmap", *words(READER))
    assert "Training Finished" in said
    return said, folder / "toy" / method / "now" / "config.yml"


def evaluated(config, folder):
    run(folder, PROGRAMS / "ns-eval", "--load-config", config, "--output-path", folder / "eval.json")
    return json.loads((folder / "eval.json").read_text())["results"]["psnr"]


def test_splatfacto_trains_evaluates_and_exports_alone(scene, tmp_path):
    said, config = trained(scene, tmp_path / "run", "splatfacto")
    assert "CLEAR" not in said
    assert evaluated(config, tmp_path) > 5
    if importlib.util.find_spec("pymeshlab") is None:
        pytest.skip("pymeshlab is not installed: no export")
    run(tmp_path, PROGRAMS / "ns-export", "gaussian-splat", "--load-config", config, "--output-dir", tmp_path)
    assert len(read_gaussians(tmp_path / "splat.ply")) >= 60


@pytest.mark.parametrize(("strategies", "points"), [("clear", "own"), ("best", "stereo")])
def test_clear_splatfacto_trains_densifies_and_evaluates(scene, tmp_path, strategies, points):
    said, config = trained(
        scene, tmp_path / "run", "clear-splatfacto",
        **{"pipeline.model.sr": scene / "sr", "pipeline.model.strategies": strategies, "pipeline.datamanager.points": points},
    )  # fmt: skip
    done = counts(re.sub(r"\s+", " ", said))  # the console wraps its lines
    assert done["merges"] == STEPS
    assert done["HR renders"] >= STEPS // 2
    assert done["structure changes"] >= 1
    assert evaluated(config, tmp_path) > 5


def test_strategies_for_splatfacto_are_refused_before_it_starts(scene, tmp_path):
    said = run(tmp_path, "--strategies", "best", PROGRAMS / "ns-train", "splatfacto", "--data", scene, status=2)
    assert "clear-splatfacto --pipeline.model.strategies best" in said
    assert not (tmp_path / "outputs").exists()
