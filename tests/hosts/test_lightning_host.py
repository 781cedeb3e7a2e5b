"""The real gaussian-splatting-lightning, on a CPU: from the start through densification, checkpoints, evaluation and resume.

    CLEAR_HOSTS=FOLDER python -m pytest tests/hosts

FOLDER holds a checkout named lightning; nothing is fetched, and without it these tests are skipped. Its CUDA modules are
replaced by tests/hosts/cpu. lightning 2.5.2, jsonargparse[signatures], torchmetrics, plyfile, opencv and matplotlib must be
installed; lightning 2.5.5 parses a checkpoint's settings and cannot read this host's.
"""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.data.ply import read_gaussians
from tests.helpers.host_parts import FROM_START
from tests.helpers.real_hosts import checkout, run, spoil_half

STEPS = 30


@pytest.fixture
def host():
    return checkout("lightning", "main.py")


GROWTH = {"densify_from_iter": 4, "densification_interval": 5, "densify_until_iter": 25}
VANILLA = {"class_path": "VanillaDensityController", "init_args": {**GROWTH, "densify_grad_threshold": 1e-5}}
MCMC = {
    "class_path": "internal.density_controllers.mcmc_density_controller.MCMCDensityController",
    "init_args": {**GROWTH, "cap_max": 100, "min_opacity": 0.4},
}


def train(host, scene, output, *more, base=VANILLA, model=None, status=0, **settings):
    density = {
        "class_path": "integration.lightning.ClearDensityController",
        "init_args": {
            "base": base, "sr": str(scene / "sr"), "overrides": FROM_START, **settings,
        },
    }  # fmt: skip
    config = output.with_suffix(".yaml")
    config.write_text(
        json.dumps({"model": {"density": density, "save_ply": True, **(model or {})}})
    )  # YAML contains JSON
    return run(
        host, "main.py", "fit", "--config", config, "--data.path", scene, "--data.parser", "Colmap",
        "--data.parser.split_mode", "experiment", "--trainer.accelerator", "cpu", "--max_steps", STEPS,
        "--save_iterations", "[20]", "-n", "run", "--output", output, "--logger",
        "lightning.pytorch.loggers.CSVLogger", *more, status=status,
    )  # fmt: skip


def cloud(output):
    return read_gaussians(output / "run" / "point_cloud" / f"iteration_{STEPS}" / "point_cloud.ply")


def test_it_trains_densifies_saves_and_continues_as_if_it_had_not_stopped(host, scene, tmp_path):
    said = train(host, scene, tmp_path / "whole")
    assert re.search(r"densify_until_iter=1\d instead of 25", said)
    whole = cloud(tmp_path / "whole")
    assert len(whole) != 60
    checkpoint = next((tmp_path / "whole" / "run" / "checkpoints").glob("*step=19.ckpt"))
    continued = train(host, scene, tmp_path / "continued", "--ckpt_path", checkpoint)
    assert "f_det starts from zero" not in continued
    resumed = cloud(tmp_path / "continued")
    assert len(resumed) == len(whole)
    assert torch.allclose(resumed.means, whole.means, atol=0.05)


def test_a_checkpoint_holds_f_base_and_f_det(host, scene, tmp_path):
    train(host, scene, tmp_path / "whole")
    last = max((tmp_path / "whole" / "run" / "checkpoints").glob("*.ckpt"), key=lambda file: file.stat().st_mtime)
    # Only a program in the host's folder can unpickle its settings.
    run(
        host, "-c", f"import torch; torch.save(torch.load({str(last)!r})['state_dict'], {str(tmp_path / 'state.pt')!r})"
    )
    sh0 = torch.load(tmp_path / "state.pt")["gaussian_model.gaussians.shs_dc"]
    assert torch.allclose(cloud(tmp_path / "whole").sh0, sh0, atol=1e-6)


def test_it_trains_with_the_hosts_mcmc(host, scene, tmp_path):
    train(host, scene, tmp_path / "mcmc", base=MCMC)
    assert len(cloud(tmp_path / "mcmc")) > 60


@pytest.mark.parametrize(
    "processor",
    [
        {"class_path": "internal.output_processors.exposure.ExposureProcessor"},
        {"class_path": "internal.output_processors.bilagrid.BilagridProcessor", "init_args": {"fused": False}},
    ],
    ids=["exposure", "bilateral grid"],
)
def test_output_processors_work_at_both_scales(host, scene, tmp_path, processor):
    train(host, scene, tmp_path / "run", model={"output_processor": processor})
    assert len(cloud(tmp_path / "run")) > 0


def test_what_a_mask_hides_is_learned_from_no_sr_image(host, scene, tmp_path):
    mask = np.full((16, 24), 255, dtype=np.uint8)
    mask[:, 12:] = 0
    names = ["b1.png", "b2.png", "b3.png"]
    (tmp_path / "masks").mkdir()
    for name in names:
        Image.fromarray(mask).save(tmp_path / "masks" / f"{name}.png")
    masked = ["--data.parser.mask_dir", tmp_path / "masks"]
    train(host, scene, tmp_path / "whole", *masked)
    spoil_half(scene / "sr", *names)
    train(host, scene, tmp_path / "spoilt", *masked)
    whole, spoilt = cloud(tmp_path / "whole"), cloud(tmp_path / "spoilt")
    assert all(torch.equal(getattr(whole, name), getattr(spoilt, name)) for name in ("means", "opacities", "sh0"))


def test_a_random_background_is_the_same_at_both_scales(host, scene, tmp_path):
    train(host, scene, tmp_path / "run", model={"random_background": True})
    assert len(cloud(tmp_path / "run")) > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--trainer.precision", "bf16-mixed"], "gradients are merged in 32 bits, got precision=bf16-mixed"),
        (["--trainer.devices", "2"], "one process trains, got 2"),
    ],
    ids=["precision", "processes"],
)
def test_settings_that_do_not_work_with_two_scales_are_refused_at_the_start(host, scene, tmp_path, options, message):
    said = train(host, scene, tmp_path / "run", *options, status=1)
    assert message in said
    assert not (tmp_path / "run" / "run" / "point_cloud").exists()
