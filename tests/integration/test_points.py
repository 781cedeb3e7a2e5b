"""Initial points by stereo in gsplat's simple_trainer and in a 3DGS-style train.py: where they lie, and who trains them."""

import importlib.util
import inspect
import logging
import sys
from functools import cache
from pathlib import Path

import pytest
import torch

from clear_strategies.geometry import stereo
from clear_strategies.geometry.projection import intrinsics
from integration import HostError, views
from integration.gsplat import simple_trainer
from integration.inria.from_options import install as install_in_inria
from integration.views import HostPhoto, stereo_points
from rasterizers.geometry import SH_C0
from tests.helpers import toy
from tests.helpers.host_parts import FROM_START, N, options

SCRIPT = Path(__file__).parents[1] / "helpers" / "simple_trainer.py"


@cache
def expected():
    """What `stereo` gives for the photos of the toy scene."""
    photos = host_photos()
    poses, Ks = (torch.stack([getattr(photo, name) for photo in photos]) for name in ("world_to_camera", "K"))
    return stereo([photo.image for photo in photos], poses, Ks)


def host_photos():
    photos = [view.lr for view in toy.scene(N).train]
    return [HostPhoto("", p.image, p.camera.world_to_camera, intrinsics(p.camera)) for p in photos]


def assert_starts_there(means, sh0):
    """As many Gaussians as points, at their places and with their colours; roundings move a few, far away."""
    points, colors = expected().means, expected().colors
    assert len(means) == len(points)
    distance, nearest = (means[:, None] - points).norm(dim=2).min(1)
    assert (distance < 0.01).float().mean() > 0.95
    assert ((sh0.reshape(-1, 3) * SH_C0 + 0.5 - colors[nearest]).abs().amax(1) < 0.01).float().mean() > 0.95


# ---- what hosts share
def test_one_line_says_what_was_found_and_a_large_cloud_is_reduced(monkeypatch, caplog):
    photos = host_photos()
    with caplog.at_level(logging.INFO):
        whole = stereo_points(photos)
    assert [r.message for r in caplog.records if r.name == "integration.views"] == [
        f"points=stereo: {expected().summary}."
    ]
    monkeypatch.setattr(views, "MAX_POINTS", 50)
    with caplog.at_level(logging.INFO):
        few = stereo_points(photos)
    assert len(few) == 50
    assert set(map(tuple, few.means.tolist())) <= set(map(tuple, whole.means.tolist()))
    assert "50 of them, chosen at random, are used" in caplog.text
    assert torch.equal(few.means, stereo_points(photos).means)


# ---- gsplat's simple_trainer
@pytest.fixture
def trainer(monkeypatch):
    """A fresh module of the stand-in."""
    pytest.importorskip("gsplat", reason="pip install gsplat")
    spec = importlib.util.spec_from_file_location("simple_trainer_of_a_test", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def runner_of(trainer, tmp_path, **settings):
    return trainer.Runner(0, 0, 1, trainer.Config(str(tmp_path), **settings))


def install(trainer, **settings):
    from integration.gsplat import install

    install(trainer.Runner, strategies="svs", overrides=["objective=lr_only"], **settings)


def test_splats_start_at_the_stereo_cloud_and_their_optimizers_have_them(trainer, tmp_path):
    install(trainer, points="stereo")
    runner = runner_of(trainer, tmp_path)
    assert_starts_there(runner.splats["means"].detach(), runner.splats["sh0"].detach())
    assert len(runner.parser.points) == N  # depths of the host's own points stay what they were
    for name, p in runner.splats.items():
        assert runner.optimizers[name].param_groups[0]["params"][0] is p
        assert len(p) == len(expected().means)


@pytest.mark.parametrize(("init_type", "points"), [("sfm", "own"), ("random", "stereo")])
def test_splats_start_at_the_hosts_own_points_by_default_or_if_random(trainer, tmp_path, init_type, points, caplog):
    own = runner_of(trainer, tmp_path, init_type=init_type).splats
    install(trainer, **({"points": points} if points == "stereo" else {}))
    for name, p in runner_of(trainer, tmp_path, init_type=init_type).splats.items():
        assert torch.equal(p, own[name])
    warned = "points=stereo has no effect with init_type=random. Set init_type=sfm." in caplog.text
    assert warned == (points == "stereo")


def test_a_script_without_the_hosts_functions_is_refused(trainer):
    class Runner:
        def train(self):
            """Nothing."""

        rasterize_splats = train

    with pytest.raises(HostError, match=r"has no create_splats_with_optimizers.*points3D\.ply"):
        simple_trainer.start_from_stereo(Runner)
    del trainer.Dataset
    with pytest.raises(HostError, match="has no Dataset"):
        install(trainer, points="stereo")


# ---- 3DGS-style train.py
def own_gaussians(host, folder, **settings):
    opt = options(host, folder, **settings)
    return *host.setup(opt), opt


def install_stereo(gaussians, scene, opt, folder, **settings):
    return install_in_inria(gaussians, scene, opt, points="stereo", sr=folder / "sr", overrides=FROM_START, **settings)


@pytest.mark.parametrize("newer", [False, True])
def test_gaussians_are_made_again_at_the_stereo_cloud(newer, inria_host, inria_capture):
    gaussians, scene, opt = own_gaussians(inria_host, inria_capture)
    if newer:
        gaussians.__class__ = sys.modules["scene.gaussian_model"].WithExposures
    before = gaussians.optimizer
    clear = install_stereo(gaussians, scene, opt, inria_capture)
    assert_starts_there(gaussians._xyz.detach(), gaussians._features_dc.detach())
    assert gaussians.optimizer is not before
    (xyz,) = (g for g in gaussians.optimizer.param_groups if g["name"] == "xyz")
    assert xyz["params"][0] is gaussians._xyz
    assert clear.params()["means"] is gaussians._xyz
    assert gaussians.spatial_lr_scale == scene.cameras_extent
    assert len(gaussians.xyz_gradient_accum) == len(gaussians._xyz)
    if newer:
        assert gaussians.exposed == [camera.image_name for camera in scene.cameras]
    clear.remove()


OTHER_SHAPES = {
    "has no create_from_pcd, which a GaussianModel has": lambda patch, model: patch.delattr(model, "create_from_pcd"),
    r"must take pcd, and .* got \(pcd, octree, spatial_lr_scale\)": lambda patch, model: patch.setattr(
        model.create_from_pcd,
        "__signature__",
        inspect.signature(lambda self, pcd, octree, spatial_lr_scale: 0),
        raising=False,
    ),
    "has no BasicPointCloud": lambda patch, model: patch.delattr(sys.modules[model.__module__], "BasicPointCloud"),
    "has no cameras_extent": None,
}


@pytest.mark.parametrize("message", OTHER_SHAPES)
def test_a_fork_of_another_shape_is_refused_with_the_file_as_remedy(message, inria_host, inria_capture, monkeypatch):
    gaussians, scene, opt = own_gaussians(inria_host, inria_capture)
    if (change := OTHER_SHAPES[message]) is None:
        del scene.cameras_extent, gaussians.spatial_lr_scale
    else:
        change(monkeypatch, type(gaussians))
    with pytest.raises(HostError, match=message) as refused:
        install_stereo(gaussians, scene, opt, inria_capture)
    assert "docs/how-to/stereo.md" in str(refused.value)
