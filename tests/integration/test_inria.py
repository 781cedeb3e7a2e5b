"""CLEAR beside an Inria-shaped loop: two added lines or none, densification before or after the step, any subset."""

from __future__ import annotations

import importlib
import logging
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import toy
from safetensors.torch import load_file

import rasterizers
from clear_strategies import GCO, P2G, SVS, AnchorError, Conductor, DataError, Objective
from clear_strategies.data.view import Photo, View
from clear_strategies.density import DensitySettings
from clear_strategies.fit import FitSettings, TrainState, iterate
from clear_strategies.mip import MipFilter
from clear_strategies.optim import LearningRates
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay, scaled
from integration import launch
from integration.attach import HostError
from integration.inria import attach, enlarged, intrinsics
from integration.lineage import change

HOST = Path(__file__).parent / "inria_host"
AT_ONCE = Objective(lambda_hr=WarmupDecay(start=0, full=1, decay_from=100, end=100))
SILENT = Objective(lambda_hr=WarmupDecay(peak=0, final=0))
STEPS, N = 25, 24
SUBSETS = {
    "baseline": (),
    "gco": (GCO(),),
    "p2g": (P2G(patch=4),),
    "svs": (scaled(SVS(anchor_weights={"means": 1e-4, "scales": 1e-4, "detail": 1e-6}), STEPS / 10_000),),
}
SUBSETS["clear"] = SUBSETS["gco"] + SUBSETS["p2g"] + SUBSETS["svs"]


@pytest.fixture
def host(monkeypatch):
    """The stand-in's train.py; its modules' names are too common to stay."""
    monkeypatch.syspath_prepend(str(HOST))
    yield importlib.import_module("train")
    for name in [m for m in sys.modules if m.split(".")[0] in ("train", "scene", "gaussian_renderer")]:
        del sys.modules[name]


@pytest.fixture
def folder(host, tmp_path):
    importlib.import_module("scene").write(tmp_path, toy.scene(N))
    return tmp_path


def options(host, folder, **settings):
    opt = host.parser().parse_args(["-s", str(folder)])
    for name, value in settings.items():
        setattr(opt, name, value)
    return opt


def trained(host, folder, strategies, objective=AT_ONCE, **settings):
    """Train with the two lines."""
    opt = options(host, folder, **settings)
    gaussians, scene = host.setup(opt)
    render, grads = host.render, {}

    def between(iteration):
        grads.update({k: p.grad.clone() for k, p in clear.params().items() if p.grad is not None})

    clear = attach(
        gaussians, scene.getTrainCameras(), Conductor(*strategies, objective=objective), sr=folder / "sr",
        threshold=opt.densify_grad_threshold, densify_until=opt.densify_until_iter,
    )  # fmt: skip
    render = clear.wrap(render)
    host.training(opt, gaussians, scene, render, between=between)
    return gaussians, clear, grads


def double(view):
    def photo(p):
        return Photo(replace(p.camera, world_to_camera=p.camera.world_to_camera.double()), p.image.double())

    return View(view.name, photo(view.lr), photo(view.hr))


def test_its_steps_are_those_of_our_own_trainer(host, folder):
    """In float64, and no Gaussian round: Adam follows the sign of a gradient that is nothing but rounding."""
    conductors = [
        Conductor(*SUBSETS["clear"], objective=scaled(Objective(), STEPS / 10_000), statistics_from=1) for _ in range(2)
    ]
    opt = options(host, folder, iterations=STEPS, densify_until_iter=0, sh_interval=1)
    toy_scene = toy.scene(N)
    gaussians, scene = host.setup(opt)
    clear = attach(gaussians, scene.getTrainCameras(), conductors[0], sr=folder / "sr")
    clear._views = {name: double(view) for name, view in clear._views.items()}
    views = tuple(clear._views[view.name] for view in toy_scene.train)

    own = TrainState.start(
        replace(toy_scene, train=views), conductors[1],
        settings=FitSettings(iterations=STEPS, degree_every=1, fused="off", scale_schedule=False),
        density=DensitySettings(start=1_000, stop=1_001), rates=LearningRates(means=LogLinear(1.6e-4, 1.6e-4, 1)),
        mip=MipFilter(variance=0),
    )  # fmt: skip
    own.field.double()
    own.field.scales += 0.3 * torch.randn(N, 3, generator=torch.Generator().manual_seed(1))
    adam, start = own.optimizer, own.field.scales.data.clone()
    adam.first, adam.second = ({k: v.double() for k, v in moments.items()} for moments in (adam.first, adam.second))
    rasterizer = rasterizers.load("torch", near=0.01, kernel=0.3, antialiased=False)
    names = []
    for _ in range(STEPS):
        names.append(own.view().name.removesuffix(".png"))
        iterate(own, rasterizer)

    for name, p in clear.params().items():
        p.data = p.data.double() if name != "scales" else start
    gaussians.optimizer.param_groups[0]["lr"] = 1.6e-4 * adam.extent
    gaussians.active_sh_degree = -1
    for camera in scene.cameras:
        camera.original_image, camera.world_view_transform = camera.original_image.double(), camera.world_view_transform.double()
    host.training(opt, gaussians, scene, clear.wrap(host.render), names)

    found = clear.params()
    for name, p in own.field.raw().items():
        difference = float((p.flatten() - found[name].detach().flatten()).norm() / p.norm().clamp_min(1e-12))
        assert difference < 1e-4, name
    assert clear.attachment.counts["merged"] == STEPS
    assert clear.attachment.counts["HR renders"] == STEPS - 1  # lambda_HR is 0 until t = 1
