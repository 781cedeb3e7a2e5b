"""CLEAR by the class path of a density controller, in a stand-in for gaussian-splatting-lightning."""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.data.photo_files import write_png
from integration.attach import HostError
from tests.helpers import toy

N = 24
AT_ONCE = ["objective.lambda_hr.start=0", "objective.lambda_hr.full=0", "strategies.p2g.patch=4"]


@pytest.fixture
def host(monkeypatch):
    """The stand-in's module, our controller, and photographs."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "helpers" / "lightning_host"))
    splatting = importlib.import_module("internal.gaussian_splatting")
    controller = importlib.import_module("integration.lightning").ClearDensityController
    scene = toy.scene(N)
    photos = []
    for view in scene.train:
        c = view.lr.camera
        numbers = (torch.tensor(x) for x in (c.fx, c.fy, c.cx, c.cy, c.width, c.height))
        camera = splatting.Camera(*numbers, c.world_to_camera.T)
        photos.append((f"images/{view.name}.png", camera, view.lr.image.permute(2, 0, 1)))
    yield SimpleNamespace(splatting=splatting, controller=controller, scene=scene, photos=photos)
    for name in [m for m in sys.modules if m.split(".")[0] == "internal" or m == "integration.lightning"]:
        del sys.modules[name]


@pytest.fixture
def sr(host, tmp_path):
    for view in host.scene.train:
        write_png(tmp_path / f"{view.name}_x4.png", images.quantize(view.hr.image))
    return str(tmp_path)


def fitted(host, density, steps, pixels=True):
    torch.manual_seed(0)
    module = host.splatting.GaussianSplatting(host.scene.cloud, density, host.splatting.Renderer(pixels))
    host.splatting.fit(module, host.photos, steps)
    return module


def handle(module):
    """What a user has no need of: the attachment behind the replaced method."""
    return module.training_step.func.__self__


def test_named_in_yaml_it_trains_with_the_density_controller_of_the_host(host, sr):
    settings = {"sr": sr, "suffix": "_x4", "overrides": AT_ONCE}
    module = fitted(host, host.controller(**settings), 16)
    n = module.gaussian_model.n_gaussians
    attachment = handle(module).attachment
    assert n != N
    assert attachment.counts["merged"] == attachment.counts["HR renders"] == 16
    assert attachment.counts["structure changes"] >= 2
    detail = attachment._params()["detail"]
    assert detail.shape == (n, 3)
    assert bool((detail != 0).any())
    # The host finds its own controller, under the names of its own checkpoints.
    assert "density_controller.xyz_gradient_accum" in module.state_dict()
    assert not any("detail" in name for name in module.state_dict())
    # What is saved and shown has f_det; what is trained has not.
    trained = module.gaussian_model.gaussians["shs_dc"]
    assert torch.allclose(module.saved[0] - trained, detail[:, None] / 0.28209479177387814, atol=1e-6)
    with torch.no_grad():
        camera = host.photos[0][1]
        shown = module.eval()(camera)["render"]
        trained += detail[:, None] / 0.28209479177387814
        handle(module)._eye._detail = None
        assert torch.allclose(shown, module(camera)["render"], atol=1e-6)


def test_centres_in_pixels_and_in_ndc_give_the_same_densification(host, sr):
    norms = []
    for pixels in (True, False):
        settings = {"sr": sr, "suffix": "_x4", "clear": "p2g", "overrides": AT_ONCE}
        module = fitted(host, host.controller(**settings), 1, pixels)
        size = torch.tensor([[12.0, 8.0]]) if pixels else 1.0
        norms.append((module.points.grad[:, :2] * size).norm(dim=-1))
    assert torch.allclose(*norms, rtol=1e-4, atol=1e-9)
    assert float(norms[0].max()) > 0


def test_each_strategy_alone_changes_what_it_should(host, sr):
    def gradients(*clear, **settings):
        overrides = ["objective.lambda_hr.start=0", "objective.lambda_hr.full=0", *settings.pop("overrides", ())]
        name = clear[0] if clear else "baseline"
        density = host.controller(clear=name, sr=sr, suffix="_x4", overrides=overrides)
        module = fitted(host, density, 1)
        return module.grads, handle(module).attachment

    plain, base = gradients()
    gco, with_gco = gradients("gco")
    _, with_p2g = gradients("p2g", overrides=["strategies.p2g.patch=4"])
    svs, _ = gradients("svs", overrides=["strategies.svs.dropout.shape=constant", "strategies.svs.dropout.maximum=0.5"])
    assert base.counts == Counter({"HR renders": 1, "LR renders": 1, "merged": 1})
    assert 0 < with_gco.log["corrected"] < 1
    assert any(not torch.equal(gco[name], plain[name]) for name in plain)
    assert with_p2g.counts["scores handed over"] == 1
    dropped = svs["means"].abs().sum(1) == 0
    assert 5 <= int((dropped & (plain["means"].abs().sum(1) > 0)).sum()) <= N - 5


def test_without_hr_no_super_resolution_is_needed(host):
    off = ["objective.lambda_hr.peak=0", "objective.lambda_hr.final=0"]
    module = fitted(host, host.controller(clear="svs", overrides=off), 3)
    assert handle(module).attachment.counts == {"LR renders": 3, "merged": 3}
    with pytest.raises(ValueError, match="sr must say where the SR pictures are"):
        fitted(host, host.controller(clear="svs"), 3)


def test_a_controller_without_a_threshold_makes_the_score_idle(host, sr, caplog):
    base = importlib.import_module("internal.density_controllers.density_controller").DensityController()
    fitted(host, host.controller(base=base, clear="p2g", sr=sr, suffix="_x4", overrides=["strategies.p2g.patch=4"]), 1)
    assert "DensityController reads no screen gradient: the densification score of P2G has no effect" in caplog.text


def test_the_number_of_steps_must_be_known(host, sr):
    with pytest.raises(HostError, match="max_steps=-1"):
        fitted(host, host.controller(sr=sr, suffix="_x4"), -1)


def test_a_resumed_run_goes_on_at_its_step_and_says_what_it_lost(host, sr, caplog):
    module = fitted(host, host.controller(sr=sr, suffix="_x4", overrides=AT_ONCE), 4)
    again = handle(module)
    again.attachment = None
    module.trainer.global_step = 3
    _, camera, image = host.photos[0]
    module.training_step((camera, ("images/view0.png", image, torch.zeros(1)), None), 0)
    assert again.attachment.t == 4
    assert "resumed at step 3" in caplog.text
    assert "masks are for the photographs alone" in caplog.text
