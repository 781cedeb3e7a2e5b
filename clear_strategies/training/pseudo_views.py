"""Steps on pseudo views: beside the training cameras, the LR loss holds the field to what the photos show.

A pseudo view is no photo: it has no HR side, no densification statistics, no part in any strategy. Its step is one more
step of the optimizer after that of the iteration's own view.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.finite import require_finite, require_finite_losses
from clear_strategies.data.pseudo_views import PseudoView, cut_out, pseudo_views
from clear_strategies.data.scene import Scene
from clear_strategies.errors import SettingError
from rasterizers.interface import Rasterizer

if TYPE_CHECKING:
    from clear_strategies.training.state import TrainState

_log = logging.getLogger(__name__)

LOSS: Final = "loss_pseudo"
"""The column of the history: the LR loss of the iteration's pseudo view."""


@dataclass(frozen=True, slots=True)
class PseudoViewSettings:
    """Pseudo views: LR photos warped by their stereo depth to cameras beside theirs, see `data.pseudo_views`.

    Args:
        every: iterations from one step on a pseudo view to the next; 0: none.
        count: how many pseudo views are made before training.
        reach: largest distance of a pseudo camera from its photo's, as a multiple of the photo's median depth.
        weight: of their LR loss, > 0, as a multiple of a photo's, which is lambda_lr.
        tolerance: largest relative difference between the depth of a point and that of a photo that vouches for it.
        max_pixels: larger LR photos are first reduced by a whole factor; bounds time and memory.

    Raises:
        SettingError: a setting is outside its range.
    """

    every: int = 0
    count: int = 256
    reach: float = 1.2
    weight: float = 1.0
    tolerance: float = 0.02
    max_pixels: int = 64_000

    def __post_init__(self) -> None:
        for name, least in (("every", 0), ("count", 1), ("max_pixels", 1)):
            if getattr(self, name) < least:
                raise SettingError(f"{name} must be at least {least}, got {getattr(self, name)}.")
        for name in ("reach", "weight", "tolerance"):
            if not getattr(self, name) > 0:
                raise SettingError(f"{name} must be > 0, got {getattr(self, name)}.")


@dataclass(frozen=True, slots=True)
class PseudoViews:
    """The pseudo views of a run. They are a function of the scene and the seed, so a checkpoint holds none of them."""

    settings: PseudoViewSettings = field(default_factory=PseudoViewSettings)
    views: Sequence[PseudoView] = ()

    @classmethod
    def of(cls, scene: Scene, settings: PseudoViewSettings, seed: int, lambda_lr: float = 1.0) -> PseudoViews:
        """Make them, on the device of the scene's views; none, and a message, where they are of no use.

        Args:
            lambda_lr: the weight of the LR loss.
        """
        if settings.every == 0:
            return cls(settings)
        if lambda_lr == 0:
            _log.warning("pseudo_views has no effect: it is the LR loss on them that trains, and lambda_lr is 0.")
            return cls(settings)
        photos = {view.name: view.lr.to("cpu") for view in scene.train}
        if cut_out(photos.values(), scene.background):
            _log.info(
                "no pseudo views are made: the photos show an object before a plain background, and where a photo shows "
                "the background nothing can hide."
            )
            return cls(settings)
        made = pseudo_views(
            photos,
            {view.name: view.depth.to("cpu") for view in scene.train if view.depth is not None},
            count=settings.count,
            reach=settings.reach,
            tolerance=settings.tolerance,
            max_pixels=settings.max_pixels,
            background=scene.background,
            seed=seed,
        )
        if not made:
            _log.warning(
                "pseudo_views has no effect: fewer than two training photos have stereo depth (data.cloud.init=stereo)."
            )
        return cls(settings, [view.to(scene.device) for view in made])

    @property
    def known(self) -> float:
        """The mean share of their pixels whose colour is known."""
        return float(torch.stack([view.known.float().mean() for view in self.views]).mean()) if self.views else 0.0

    def says(self) -> str | None:
        """A phrase for the plan; None without pseudo views."""
        if not self.views:
            return None
        return (
            f"{len(self.views)} beside the training cameras, {self.known:.0%} of their pixels known, one every "
            f"{self.settings.every} iterations"
        )

    def due(self, t: int, seed: int) -> PseudoView | None:
        """The pseudo view of iteration t: a function of (seed, t)."""
        if not self.views or t % self.settings.every:
            return None
        generator = torch.Generator().manual_seed(seed * 1_000_003 + t)
        return self.views[int(torch.randint(len(self.views), (), generator=generator))]


def step(s: TrainState, rasterizer: Rasterizer, view: PseudoView) -> Number:
    """One step of the optimizer on the LR loss where the pseudo view is known; returns the loss.

    Raises:
        DivergedError: the loss or its gradient is not finite; nothing has changed.
    """
    θ, o = s.field, s.conductor.objective
    shot = θ.shot(rasterizer, view.photo.camera, depth=s.depth_loss.weight > 0)
    if s.depth_loss.weight > 0:
        s.depth_loss.added(shot, view.depth)
    known = view.known[..., None]
    losses = o.lr(torch.where(known, shot.image, 0.0), view.photo.image)  # Eq. 4, equal where unknown
    where = f"t={s.t}, a pseudo view"
    require_finite_losses(where, losses.values, {"it": view.photo.image, "the render": shot.image})
    cotangents: Tensor = losses.cotangents * known * s.pseudo_views.settings.weight
    steps = s.optimizer.steps
    if s.compiled_step is not None:
        (g,) = s.compiled_step.vjp(shot, cotangents)
        require_finite(f"{where}: the gradient", g.table())
        s.compiled_step.step(θ.raw(), g, None, s.t)
    else:
        (grads,) = shot.vjp(cotangents)
        require_finite(f"{where}: the gradient", grads)
        s.optimizer.step(θ.raw(), s.conductor.merge(θ.raw(), grads, None, s.t).grads, shot.visible)
        θ.constrain()
    s.optimizer.steps = steps  # the learning rates follow the iteration
    return losses.values["lr"]
