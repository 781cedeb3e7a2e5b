"""gsplat's own examples/simple_trainer.py, on a CPU: both of its densifiers, evaluation, and the files that it writes.

    CLEAR_HOSTS=FOLDER python -m pytest tests/hosts

FOLDER holds checkouts named gsplat-1.5.3 and gsplat-1.6.0; nothing is fetched, and those that are not there are skipped. What
their examples/requirements.txt lists must be installed, but for the packages that CUDA compiles; for 1.6.0 also COLMAP's pycolmap
and piexif.
"""

import pytest
import torch

from clear_strategies.data.ply import read_gaussians
from tests.helpers.real_hosts import HOSTS, checkout, clear, counts, run, stereo_points

STEPS = 30


@pytest.fixture(params=["gsplat-1.5.3", "gsplat-1.6.0"])
def host(request):
    return checkout(request.param, "examples/simple_trainer.py")


def start(host, *command, status=0):
    paths = (host, host / "examples")
    if host.name == "gsplat-1.5.3":
        paths = (HOSTS / "pycolmap_of_gsplat_1_5", *paths)
    return run(host, *command, inside="examples", more_paths=paths, status=status)


def training(scene, results, **more):
    """simple_trainer's options."""
    settings = {
        "data-dir": scene, "data-factor": 1, "result-dir": results, "max-steps": STEPS, "eval-steps": STEPS,
        "save-steps": STEPS, "ply-steps": STEPS, "strategy.refine-start-iter": 4, "strategy.refine-every": 5,
        "strategy.refine-stop-iter": 25, **more,
    }  # fmt: skip
    named = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    return [*named, "--save-ply", "--disable-viewer", "--disable-video"]


def launched(host, scene, results, densifier="default", *extra, points="own", status=0, **more):
    options = training(scene, results, **more)
    return start(host, *clear(scene, points), "simple_trainer.py", densifier, *options, *extra, status=status)


def stored(results):
    return torch.load(next((results / "ckpts").glob("*.pt")), weights_only=True)["splats"]


@pytest.mark.parametrize("densifier", ["default", "mcmc"])
def test_it_trains_densifies_evaluates_and_saves_what_its_own_evaluation_reads(host, scene, tmp_path, densifier):
    threshold = {"strategy.grow-grad2d": 1e-5} if densifier == "default" else {}
    said = launched(host, scene, tmp_path / "run", densifier, **threshold)
    assert "refine_stop_iter=15 instead of 25" in said  # SVS ends densification at half of max_steps
    assert counts(said)["merges"] == STEPS
    assert counts(said)["HR renders"] == STEPS
    assert counts(said)["structure changes"] >= 1
    assert "PSNR" in said
    splats = stored(tmp_path / "run")
    assert set(splats) == {"means", "scales", "quats", "opacities", "sh0", "shN"}
    assert len(splats["means"]) > 60
    written = read_gaussians(next((tmp_path / "run" / "ply").glob("*.ply")))
    assert torch.allclose(written.sh0, splats["sh0"], atol=1e-6)  # f_base + f_det in both
    file = next((tmp_path / "run" / "ckpts").glob("*.pt"))
    again = training(scene, tmp_path / "again")
    assert "PSNR" in start(host, "simple_trainer.py", densifier, *again, "--ckpt", file)


def test_it_starts_from_stereo_between_its_photos(host, scene, tmp_path):
    said = launched(host, scene, tmp_path / "run", points="stereo", **{"strategy.refine-start-iter": STEPS})
    assert f"Number of GS: {stereo_points(said)}" in said
    assert counts(said)["merges"] == STEPS
    assert len(stored(tmp_path / "run")["means"]) == stereo_points(said)
    random = launched(
        host, scene, tmp_path / "random", "default", "--init-type", "random", points="stereo", **{"init-num-pts": 80}
    )
    assert "points=stereo has no effect with init_type=random" in random


@pytest.mark.parametrize("option", ["--packed", "--sh-fp16", "--pose-opt", "--strategy.absgrad"])
def test_other_ways_to_draw_train_and_densify(host, scene, tmp_path, option):
    if option == "--sh-fp16" and host.name == "gsplat-1.5.3":
        pytest.skip("since 1.6.0")
    more = {"strategy.grow-grad2d": 1e-5} | ({"pose-noise": 0.01} if option == "--pose-opt" else {})
    said = launched(host, scene, tmp_path / "run", "default", option, **more)
    assert counts(said)["merges"] == STEPS
    assert counts(said)["structure changes"] >= 1
    assert {p.dtype for p in stored(tmp_path / "run").values()} == {torch.float32}


@pytest.mark.parametrize("options", ["default", "mcmc", "default --packed --visible-adam", "default --strategy.absgrad",
                                     "default --pose-opt", "default --batch-size 2"])  # fmt: skip
def test_it_trains_alone(host, scene, tmp_path, options):
    """Without strategies."""
    if "--visible-adam" in options and host.name == "gsplat-1.6.0":
        pytest.skip("its SelectiveAdam refuses the `fused` that its trainer passes")
    densifier, *more = options.split()
    said = start(host, "simple_trainer.py", densifier, *training(scene, tmp_path / "run"), *more)
    assert "PSNR" in said
    assert "CLEAR" not in said
    assert len(stored(tmp_path / "run")["means"]) >= 60
