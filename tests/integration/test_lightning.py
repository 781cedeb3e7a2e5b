"""CLEAR as a density controller, in a stand-in for gaussian-splatting-lightning."""

from __future__ import annotations

import importlib
import io
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.data.photo_files import write_png
from clear_strategies.errors import SettingError
from integration import HostError
from rasterizers.geometry import SH_C0
from tests.helpers import toy
from tests.helpers.host_parts import FROM_START

N = 24
WITHOUT_HR = ["objective.lambda_hr.peak=0", "objective.lambda_hr.final=0"]


@pytest.fixture
def host(monkeypatch):
    """The stand-in's module, our controller, and the photos."""
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
    densities = importlib.import_module("internal.density_controllers.vanilla_density_controller")
    yield SimpleNamespace(splatting=splatting, controller=controller, densities=densities, scene=scene, photos=photos)
    for name in [m for m in sys.modules if m.split(".")[0] == "internal" or m == "integration.lightning"]:
        del sys.modules[name]


@pytest.fixture
def sr(host, tmp_path):
    """The controller's settings of the SR images."""
    for view in host.scene.train:
        write_png(tmp_path / f"{view.name}_x4.png", images.quantize(view.hr.image))
    return {"sr": str(tmp_path), "suffix": "_x4"}


def fitted(host, density, steps, pixels=True, start=0, mask=None, checkpoint=None):
    torch.manual_seed(0)
    module = host.splatting.GaussianSplatting(host.scene.cloud, density, host.splatting.Renderer(pixels))
    # the gradient of the rotation of round ones is rounding
    module.gaussian_model.gaussians["scales"].data += torch.tensor([0.0, 0.3, 0.6])
    host.splatting.fit(module, host.photos, steps, start, mask, checkpoint)
    return module


def unfitted(host, sr):
    return host.splatting.GaussianSplatting(host.scene.cloud, host.controller(**sr), host.splatting.Renderer())


def attachment_of(module):
    return module.density_controller.clear.attachment


def test_it_trains_with_the_hosts_density_controller(host, sr):
    to_the_end = [*FROM_START, "strategies.svs.anchor_start=10000"]  # the strategies let the host densify
    module = fitted(host, host.controller(**sr, overrides=to_the_end), 16)
    n = module.gaussian_model.n_gaussians
    attachment = attachment_of(module)
    assert n != N
    assert attachment.counts["merges"] == attachment.counts["HR renders"] == 16
    assert attachment.counts["structure changes"] >= 2
    assert float(module.logged["clear_base"]) > 0
    detail = attachment.params()["detail"]
    assert detail.shape == (n, 3)
    assert bool((detail != 0).any())
    # The host's controller keeps its names in checkpoints.
    assert "density_controller.xyz_gradient_accum" in module.state_dict()
    assert not any("detail" in name for name in module.state_dict())
    # Files and evaluation use f_det; training does not.
    trained = module.gaussian_model.gaussians["shs_dc"]
    assert torch.allclose(module.saved[0] - trained, detail[:, None] / SH_C0, atol=1e-6)
    with torch.no_grad():
        camera = host.photos[0][1]
        evaluated = module.eval()(camera)["render"]
        trained += detail[:, None] / SH_C0
        plain = host.splatting.Renderer()(camera, module.gaussian_model, bg_color=torch.zeros(3))["render"]
        assert torch.allclose(evaluated, plain, atol=1e-6)


def test_centres_in_pixels_and_in_ndc_give_the_same_densification(host, sr):
    norms = []
    for pixels in (True, False):
        module = fitted(host, host.controller(**sr, strategies="p2g", overrides=FROM_START), 1, pixels)
        size = torch.tensor([[12.0, 8.0]]) if pixels else 1.0
        norms.append((module.points.grad[:, :2] * size).norm(dim=-1))
    assert torch.allclose(*norms, rtol=1e-4, atol=1e-9)
    assert float(norms[0].max()) > 0


def test_dropped_gaussians_have_no_gradient(host):
    half = ["strategies.svs.dropout.shape=constant", "strategies.svs.dropout.maximum=0.5", "strategies.svs.looks=0"]
    plain, dropped = (
        fitted(host, host.controller(strategies=name, overrides=[*WITHOUT_HR, *more]), 1).grads["means"].abs().sum(1)
        > 0
        for name, more in (("baseline", ()), ("svs", half))
    )
    assert 5 <= int((plain & ~dropped).sum()) <= N - 5


def test_the_hosts_exposure_is_applied_at_both_scales(host, sr):
    module = fitted(host, host.controller(strategies="baseline", **sr, overrides=FROM_START[:2]), 1)
    assert module.output_processor.sizes == [96, 24]


def test_without_hr_no_sr_images_are_needed(host):
    module = fitted(host, host.controller(strategies="svs", overrides=WITHOUT_HR), 3)
    assert attachment_of(module).counts == {"LR renders": 3, "merges": 3}
    with pytest.raises(SettingError, match="sr: must be the folder of the SR images"):
        fitted(host, host.controller(strategies="svs"), 3)


def test_a_score_without_a_threshold_is_warned_of(host, sr, caplog):
    base = host.densities.DensityController()
    fitted(host, host.controller(base=base, strategies="p2g", **sr, overrides=["strategies.p2g.patch=4"]), 1)
    assert "DensityController does not read the screen gradient: the densification score of P2G" in caplog.text


def test_a_run_saves_its_checkpoint_and_continues_from_it_as_if_it_had_not_stopped(host, sr):
    """The host pickles its live renderer with every checkpoint, so nothing may hang on it."""
    settings = {**sr, "overrides": FROM_START}
    quiet = host.densities.VanillaDensityController(densify_until_iter=0)
    whole = fitted(host, host.controller(base=quiet, **settings), 8)
    module = fitted(host, host.controller(base=quiet, **settings), 5)
    stored = torch.load(io.BytesIO(module.checkpoint), weights_only=False)
    folded = module.gaussian_model.gaussians["shs_dc"] + attachment_of(module).params()["detail"][:, None] / SH_C0
    assert torch.allclose(stored["state_dict"]["gaussian_model.gaussians.shs_dc"], folded, atol=1e-6)
    assert torch.equal(torch.load(io.BytesIO(module.save_checkpoint()), weights_only=False)["clear"]["detail"]["value"],
                       attachment_of(module).params()["detail"])  # fmt: skip

    resumed = fitted(host, host.controller(base=quiet, **settings), 8, checkpoint=module.checkpoint)
    assert attachment_of(resumed).t == attachment_of(whole).t == 8
    for name, p in whole.gaussian_model.gaussians.items():
        assert torch.allclose(p, resumed.gaussian_model.gaussians[name], atol=1e-4), name
    assert torch.allclose(attachment_of(whole).params()["detail"], attachment_of(resumed).params()["detail"], atol=1e-4)


def test_a_masked_pixel_is_hidden_at_both_scales(host, sr):
    """A gradient of a hidden half would come from the SR image alone."""
    mask = torch.zeros(3, 16, 24)
    module = fitted(host, host.controller(strategies="gco", **sr, overrides=FROM_START[:2]), 1, mask=mask)
    assert all(float(g.abs().max()) == 0 for g in module.grads.values())
    assert attachment_of(module).log["base"] == 0


def test_mip_splattings_filter_is_that_of_the_hr_cameras(host, sr):
    module = unfitted(host, sr)
    model, widths = module.gaussian_model, []
    model._train_camera_set = [camera for _, camera, _ in host.photos]
    model.compute_3d_filter = lambda: widths.extend(int(camera.width) for camera in model._train_camera_set)
    host.splatting.fit(module, host.photos, 1)
    assert widths == [96, 96, 96]
    assert int(host.photos[0][1].width) == 24


def test_densification_ends_when_a_strategy_ends_it(host, sr):
    module = fitted(host, host.controller(**sr, strategies="svs"), 16)
    assert module.density_controller.config.densify_until_iter == 8


def test_two_photos_of_one_name_are_refused(host, sr):
    host.photos.append(host.photos[0])
    with pytest.raises(SettingError, match="is the name of several"):
        fitted(host, host.controller(**sr), 1)


@pytest.mark.parametrize(
    ("trainer", "message"),
    [
        ({"max_steps": -1}, "got max_steps=-1. Set trainer.max_steps"),
        ({"world_size": 2}, "one process trains, got 2. Set trainer.devices=1"),
        ({"precision": "16-mixed"}, "got precision=16-mixed. Set trainer.precision=32"),
    ],
    ids=lambda value: value if isinstance(value, str) else next(iter(value)),
)
def test_a_trainer_without_steps_with_several_processes_or_in_half_precision_is_refused(trainer, message, host, sr):
    module = unfitted(host, sr)
    module.trainer = SimpleNamespace(**{"global_step": 0, "max_steps": 5} | trainer)
    with pytest.raises(HostError, match=message):
        module.density_controller.setup("fit", module)


def test_models_whose_colours_are_not_those_of_the_gaussians_are_refused(host, sr):
    module = unfitted(host, sr)
    module.renderer.appearance = torch.nn.Linear(2, 2)
    with pytest.raises(HostError, match="Renderer trains an appearance model of its own"):
        host.splatting.fit(module, host.photos, 1)
    module = unfitted(host, sr)
    del module.gaussian_model.gaussians["shs_rest"]
    module.gaussian_model.training_setup = lambda: [torch.optim.Adam([module.gaussian_model.gaussians["means"]])]
    with pytest.raises(HostError, match="no shs_rest, as those of a VanillaGaussian have"):
        host.splatting.fit(module, host.photos, 1)


def test_a_resumed_run_without_our_state_continues_at_its_step_and_warns(host, sr, caplog):
    module = fitted(host, host.controller(**sr, overrides=FROM_START), 4, start=3)
    assert attachment_of(module).t == 4
    assert "resumed at step 3 from a checkpoint without CLEAR" in caplog.text
