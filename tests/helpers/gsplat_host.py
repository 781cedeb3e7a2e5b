"""A trainer like those in gsplat's documentation, on a CPU, with our rasterizer: `Host` contains nothing of CLEAR."""

import functools
from dataclasses import replace

import torch

import rasterizers
from clear_strategies import Conductor, Photo, View
from clear_strategies.data.scene import Scene
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.schedules import LogLinear
from clear_strategies.training.field import GaussianField
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from integration.gsplat import Attached, attach
from rasterizers import autograd
from tests.helpers import toy
from tests.helpers.host_parts import HR_FROM_START, photometric

rasterization = functools.partial(autograd.rasterization, backend=rasterizers.fastest("cpu"))


def drawn(function, splats, camera, sh_fp16=False, **settings):
    """Six tensors of gsplat's names, drawn by a function like gsplat's `rasterization`."""
    p = splats
    bands = [p[name].half() if sh_fp16 else p[name] for name in ("sh0", "shN")]
    activated = p["scales"].exp(), p["opacities"].sigmoid(), torch.cat(bands, 1)
    view = camera.world_to_camera[None], intrinsics(camera)[None], camera.width, camera.height
    return function(p["means"], p["quats"], *activated, *view, **{"sh_degree": 3, **settings})


class Host:
    """Parameters, optimizers and LR photos (name -> camera and image) of a gsplat-style trainer, by default of the toy scene."""

    def __init__(
        self, scene=None, extent=1.0, strategy=None, accumulation=1, eps=1e-15, rasterization=rasterization, **call
    ):
        self.rasterization, self.call = rasterization, {"packed": False, **call}
        self.scene = scene = scene or toy.scene(20)
        self.photos = {v.name: v.lr for v in scene.train}
        raw = GaussianField.from_cloud(scene.cloud).raw()
        device = scene.train[0].lr.image.device
        self.splats = {k: torch.nn.Parameter(p.clone().to(device)) for k, p in raw.items() if k != "detail"}
        rates = LearningRates().at(0, extent)
        self.optimizers = {k: torch.optim.Adam([p], lr=rates[k], eps=eps) for k, p in self.splats.items()}
        self.strategy, self.state = strategy, None
        if strategy is not None:
            strategy.check_sanity(self.splats, self.optimizers)
            self.state = strategy.initialize_state(scene_scale=extent)
        self.accumulation = accumulation
        self.grads = {}
        self.degree = lambda step: min(3, step)

    def render(self, camera, step=0):
        return drawn(self.rasterization, self.splats, camera, sh_degree=self.degree(step), **self.call)

    def step(self):
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad()

    def prune(self, n):
        """Replace the parameters, as a densifier does, by those without the first n Gaussians."""
        for name, p in self.splats.items():
            self.splats[name] = torch.nn.Parameter(p.detach()[n:], requires_grad=p.requires_grad)

    def gradients(self):
        return {name: p.grad for name, p in self.splats.items() if p.grad is not None}

    def train(self, names, between=lambda: None):
        """The order of gsplat's simple_trainer: backward, step, densify."""
        for step, name in enumerate(names):
            camera, target = self.photos[name].camera, self.photos[name].image
            renders, _, info = self.render(camera, step)
            if self.strategy is not None:
                self.strategy.step_pre_backward(self.splats, self.optimizers, self.state, step, info)
            (photometric(renders[0], target) / self.accumulation).backward()
            if (step + 1) % self.accumulation == 0:
                self.grads = {k: p.grad.clone() for k, p in self.splats.items() if p.grad is not None}
                for optimizer in self.optimizers.values():
                    optimizer.step()
                    optimizer.zero_grad(set_to_none=True)
            if self.strategy is not None:
                self.strategy.step_post_backward(
                    self.splats, self.optimizers, self.state, step, info, packed=self.call["packed"]
                )
            between()


def attached(host: Host, scene, conductor: Conductor, **settings) -> Attached:
    """CLEAR in the host's loop."""
    clear = attach(host.splats, host.optimizers, scene.train, conductor, **settings)
    host.rasterization = clear.wrap(host.rasterization)
    return clear


def trained(host: Host, scene, conductor: Conductor, names, /, **settings) -> Attached:
    """Train on the views of these names with CLEAR."""
    clear = attached(host, scene, conductor, **settings)
    host.train(names)
    clear.remove()
    return clear


def started(*strategies, conductor=None, host=None, scene=None, **settings):
    """A host on the toy scene, CLEAR in its loop, by default with HR from the start, and a function that renders its photo i."""
    host = host or Host(scene)
    scene = scene or host.scene
    clear = attached(host, scene, conductor or Conductor(*strategies, objective=HR_FROM_START), **settings)

    def render(i=0, **call):
        return drawn(host.rasterization, host.splats, scene.train[i].lr.camera, **call)[0]

    return host, clear, render


def densified(
    conductor: Conductor, strategy=None, *, colors_stay: bool = False, packed: bool = False
) -> tuple[Host, Attached]:
    """A host on the toy scene of 40 Gaussians, trained with CLEAR while gsplat's default strategy, or another, densifies.

    Args:
        colors_stay: they identify Gaussians then.
    """
    from gsplat.strategy import DefaultStrategy

    strategy = strategy or DefaultStrategy(
        refine_start_iter=4, refine_stop_iter=24, refine_every=5, grow_grad2d=2e-4, prune_opa=0.02
    )
    torch.manual_seed(0)
    scene = toy.scene(40)
    host = Host(scene, extent=4.0, strategy=strategy, packed=packed)
    if colors_stay:
        host.optimizers["sh0"].param_groups[0]["lr"] = 0.0
    names = [view.name for view in scene.train] * 10
    return host, trained(host, scene, conductor, names, strategy=strategy)


RASTERIZER = rasterizers.load(rasterizers.fastest("cpu"), near=0.01, kernel=0.3, antialiased=False)


def doubled(view: View) -> View:
    """The view with its images and poses in float64."""

    def photo(p: Photo) -> Photo:
        return Photo(replace(p.camera, world_to_camera=p.camera.world_to_camera.double()), p.image.double())

    return View(view.name, photo(view.lr), photo(view.hr))


def in_double(scene: Scene, conductor: Conductor, steps: int, eps: float = 1e-15) -> TrainState:
    """Before its first step, in float64: otherwise Adam follows the sign of gradients that consist of rounding errors."""
    state = TrainState.start(
        scene, conductor, settings=FitSettings(iterations=steps, degree_every=1, fused="off", scale_schedule=False),
        density=DensitySettings(start=1_000, stop=1_001),
        rates=LearningRates(means=LogLinear(1.6e-4, 1.6e-4, 1), eps=eps), mip=MipFilter(variance=0),
    )  # fmt: skip
    state.field.double()
    adam = state.optimizer
    adam.first, adam.second = ({k: v.double() for k, v in moments.items()} for moments in (adam.first, adam.second))
    return state
