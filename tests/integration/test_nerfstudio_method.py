"""`clear-splatfacto` in the real nerfstudio: its registry, its command line, its trainer, on a CPU.

nerfstudio needs 3.5 GB, so this file is skipped where it is absent, as in CI. docs/how-to/each-host.md shows the command.

Three things are not nerfstudio's own here: our rasterizer replaces gsplat's CUDA kernels (with gsplat 1.4's shapes, and |∇_u| as
`absgrad`), `Tensor.cuda()` returns the tensor itself, and the LPIPS network, which would be downloaded, is a constant.
"""

import copy
import functools
import importlib.metadata
import importlib.util
import json
import os
from pathlib import Path

import pytest
import torch

from tests.helpers import toy

if importlib.util.find_spec("nerfstudio") is None:
    pytest.skip("nerfstudio is not installed: docs/how-to/each-host.md", allow_module_level=True)

os.environ["TORCHDYNAMO_DISABLE"] = "1"
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.models import splatfacto
from nerfstudio.plugins.registry import discover_methods

from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import write_points
from clear_strategies.errors import SettingError
from clear_strategies.strategies import random_background
from integration.nerfstudio import clear_splatfacto
from integration.nerfstudio.data import seed_with_stereo
from integration.nerfstudio.method import ClearDatamanager, ClearSplatfactoModel, ClearSplatfactoModelConfig
from rasterizers import autograd
from rasterizers.geometry import SH_C0

STEPS = 40


@functools.wraps(autograd.rasterization)
def rasterization(render_mode="RGB", absgrad=False, **given):
    renders, alphas, info = autograd.rasterization(**given, backend="torch")
    info["radii"] = info["radii"][..., 0]
    if render_mode == "RGB+ED":
        renders = torch.cat((renders, torch.zeros_like(alphas)), -1)
    if absgrad and info["means2d"].requires_grad:
        info["means2d"].register_hook(lambda g: setattr(info["means2d"], "absgrad", g.abs()))
    return renders, alphas, info


class Lpips(torch.nn.Module):
    def __init__(self, **_):
        super().__init__()

    def forward(self, *_):
        return torch.tensor(0.5)


@pytest.fixture(autouse=True)
def on_a_cpu(monkeypatch):
    import torchmetrics.image.lpip

    monkeypatch.setattr(torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", Lpips)
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self, *_, **__: self)
    monkeypatch.setattr(splatfacto, "rasterization", rasterization)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A nerfstudio capture of the toy scene, and its SR images."""
    folder = tmp_path_factory.mktemp("capture")
    scene = toy.scene(40, train=5)
    frames = []
    for view in scene.train:
        write_png(folder / "images" / f"{view.name}.png", view.lr.image)
        write_png(folder / "sr" / f"{view.name}.png", view.hr.image)
        pose = view.lr.camera.world_to_camera.inverse() * torch.tensor([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": pose.tolist()})
    c = scene.train[0].lr.camera
    lens = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
    write_points(folder / "points.ply", scene.cloud.means, scene.cloud.colors)
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames, "ply_file_path": "points.ply"}))
    return folder


def configured(capture, out, model=None, **fields):
    """The method's own configuration, for a small scene, a CPU and no viewer."""
    config = copy.deepcopy(clear_splatfacto.config)
    if model is not None:
        config.pipeline.model = model
    config.pipeline.datamanager.data = capture
    config.pipeline.datamanager.dataparser.eval_mode = "all"
    config.machine.device_type = "cpu"
    config.vis, config.logging.local_writer.enable = "tensorboard", False
    config.output_dir, config.max_num_iterations, config.steps_per_eval_image = out, STEPS, 15
    small = {"warmup_length": 4, "refine_every": 5, "reset_alpha_every": 100, "sh_degree_interval": 10}
    for name, value in ({"sr": capture / "sr"} | small | fields).items():
        if hasattr(config.pipeline.model, name):
            setattr(config.pipeline.model, name, value)
    config.set_timestamp()
    config.set_experiment_name()
    return config


def trainer(config):
    torch.manual_seed(0)
    made = config.setup(local_rank=0, world_size=1)
    made.setup()
    return made


def test_the_registry_finds_it_by_its_entry_point(monkeypatch):
    points = importlib.metadata.entry_points(group="nerfstudio.method_configs")
    if "clear-splatfacto" not in points.names:
        pytest.skip("this package is not installed here, only on the path")
    monkeypatch.delenv("NERFSTUDIO_METHOD_CONFIGS", raising=False)
    assert discover_methods()[0]["clear-splatfacto"] is clear_splatfacto.config


def test_the_command_line_has_its_settings():
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    line = (
        "clear-splatfacto --data scene --pipeline.model.strategies gco,svs --pipeline.model.sr scene/sr "
        "--pipeline.model.overrides strategies.gco.tolerance=0.1 objective=paper --pipeline.datamanager.points stereo"
    )
    pipeline = tyro.cli(AnnotatedBaseConfigUnion, args=line.split()).pipeline
    model = pipeline.model
    assert pipeline.datamanager.points == "stereo"
    assert (model.strategies, model.sr) == ("gco,svs", Path("scene/sr"))
    assert model.overrides == ("strategies.gco.tolerance=0.1", "objective=paper")
    with pytest.raises(SettingError, match="points: must be one of own, stereo"):  # in Python, past tyro
        type(pipeline.datamanager)(points="sterio")


@pytest.mark.parametrize(
    "setting",
    [
        {"num_downscales": 2}, {"background_color": "random"}, {"use_bilateral_grid": True}, {"sh_degree": 0},
        {"factor": 1},
    ],
    ids=lambda setting: next(iter(setting)),
)  # fmt: skip
def test_settings_that_do_not_work_with_two_scales_are_refused(setting):
    with pytest.raises(SettingError, match=next(iter(setting))):
        ClearSplatfactoModelConfig(**setting)


@pytest.mark.parametrize("clear", ["gco", "p2g", "svs", "clear", "clear,random_background"])
def test_nerfstudios_trainer_trains_it(capture, tmp_path, monkeypatch, clear):
    monkeypatch.setattr(random_background, "_LONG_RUN", 0)
    overrides = ("strategies.p2g.patch=4",) if "p2g" in clear or "clear" in clear else ()
    host = trainer(configured(capture, tmp_path, strategies=clear, overrides=overrides, densify_grad_thresh=1e-4))
    model = host.pipeline.model
    attachment, before = model.attached.attachment, {k: p.detach().clone() for k, p in model.gauss_params.items()}
    assert isinstance(model, ClearSplatfactoModel)
    host.train()
    counts = attachment.counts
    assert counts["merges"] == counts["LR renders"] == STEPS
    assert STEPS - 5 <= counts["HR renders"] <= STEPS
    assert counts["structure changes"] >= 1
    assert (counts["scores written"] > 0) == bool(overrides)
    assert model.strategy.refine_stop_iter == (15_000 if clear in ("gco", "p2g") else STEPS // 2)
    n = model.num_points
    assert n != len(before["means"])
    for name, p in model.gauss_params.items():
        assert len(p) == n, name
        assert bool(p.isfinite().all()), name
        assert host.optimizers.optimizers[name].param_groups[0]["params"][0] is p, name
    assert float(model.gauss_params["detail"].abs().max()) > 0
    assert model.attached is None
    assert splatfacto.rasterization is rasterization


def test_it_starts_from_the_stereo_cloud_of_its_photos(capture, tmp_path):
    config = configured(capture, tmp_path, strategies="svs", stop_split_at=0)
    config.pipeline.datamanager.points = "stereo"
    host = trainer(config)
    model, manager = host.pipeline.model, host.pipeline.datamanager
    assert isinstance(manager, ClearDatamanager)
    cloud = seed_with_stereo(manager)
    assert torch.equal(model.gauss_params["means"], cloud.means)
    colors = model.gauss_params["features_dc"].detach() * SH_C0 + 0.5
    assert torch.allclose(colors, cloud.colors, atol=1 / 255)
    for name, p in model.gauss_params.items():
        assert len(p) == len(cloud), name
        assert host.optimizers.optimizers[name].param_groups[0]["params"][0] is p, name
    host.train()
    assert bool(model.gauss_params["means"].isfinite().all())


def test_it_starts_from_the_data_sets_points_by_default_and_in_evaluation(capture, tmp_path):
    config = configured(capture, tmp_path)
    assert config.pipeline.datamanager.points == "own"
    assert len(config.pipeline.setup(device="cpu").model.gauss_params["means"]) == 40
    config.pipeline.datamanager.points = "stereo"  # a checkpoint's Gaussians are loaded there
    assert len(config.pipeline.setup(device="cpu", test_mode="test").model.gauss_params["means"]) == 40


def test_with_hr_weight_0_it_is_splatfacto_to_the_bit(capture, tmp_path):
    nothing = ("objective.lambda_hr.peak=0", "objective.lambda_hr.final=0")
    fields = {"densify_grad_thresh": 1e-4}
    ours = trainer(configured(capture, tmp_path / "ours", strategies="baseline", overrides=nothing, **fields))
    model = splatfacto.SplatfactoModelConfig(num_downscales=0, background_color="black")
    plain = trainer(configured(capture, tmp_path / "plain", model, **fields))
    for host in (ours, plain):
        torch.manual_seed(1)
        host.train()
    a, b = ours.pipeline.model.gauss_params, plain.pipeline.model.gauss_params
    assert len(a["means"]) != 40
    for name, p in b.items():
        assert torch.equal(a[name], p), name
    assert not a["detail"].any()


def before_iteration(host, step):
    for callback in host.callbacks:
        callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)


def test_evaluation_and_exports_use_the_detail_feature(capture, tmp_path):
    host = trainer(configured(capture, tmp_path))
    model, camera = host.pipeline.model, host.pipeline.datamanager.train_dataset.cameras[:1]
    base = model.gauss_params["features_dc"]
    assert model.features_dc is base
    model.eval()
    without = model.get_outputs_for_camera(camera)
    model.gauss_params["detail"].data += 0.1
    brighter = model.get_outputs_for_camera(camera)["rgb"] - without["rgb"]
    covered = without["accumulation"][..., 0] > 0.5
    assert bool(covered.any())
    assert float(brighter[covered].mean()) == pytest.approx(
        0.1 * float(without["accumulation"][covered].mean()), rel=0.3
    )
    assert torch.equal(model.shs_0, base + model.gauss_params["detail"] / SH_C0)


def test_the_scalars_of_the_iteration_are_among_the_metrics(capture, tmp_path):
    host = trainer(configured(capture, tmp_path, strategies="gco"))
    for step in range(5):
        before_iteration(host, step)
        _, _, metrics = host.train_iteration(step)
    assert metrics["clear_t"] == 4  # the previous iteration, whose backward pass has ended
    assert 0 <= metrics["clear_corrected"] <= 1


def test_a_resumed_training_trains_on_from_its_iteration_to_the_end_that_it_has(capture, tmp_path, monkeypatch):
    """Loading a checkpoint replaces the parameters that the optimizers hold; and max_num_iterations more steps are made."""
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # its checkpoints are from before torch 2.6
    first = trainer(configured(capture, tmp_path, strategies="svs"))
    first.train()
    config = configured(capture, tmp_path / "resumed", strategies="svs")
    config.load_dir, config.load_scheduler = first.checkpoint_dir, False
    host = trainer(config)
    model = host.pipeline.model
    assert model.strategy.refine_stop_iter == STEPS  # half of the steps of both
    before = {name: p.detach().clone() for name, p in model.gauss_params.items()}
    assert all(torch.equal(p, first.pipeline.model.gauss_params[name]) for name, p in before.items())
    before_iteration(host, STEPS)
    moments = {name: len(o.state[model.gauss_params[name]]) for name, o in host.optimizers.optimizers.items()}
    assert set(moments.values()) == {3}
    host.train_iteration(STEPS)
    assert not any(torch.equal(p, before[name]) for name, p in model.gauss_params.items())
    before_iteration(host, STEPS + 1)
    host.train_iteration(STEPS + 1)
    assert model.attached.attachment.t == STEPS + 3  # the next


def test_accumulated_gradients_are_refused(capture, tmp_path):
    config = configured(capture, tmp_path)
    config.gradient_accumulation_steps = {"means": 2}
    with pytest.raises(SettingError, match="gradient_accumulation_steps"):
        trainer(config)
