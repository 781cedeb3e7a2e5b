"""The depth loss: what the LR render shows lies where stereo saw it.

Stereo gives the initial cloud its geometry, and nothing holds that geometry while the field trains. The loss is

    L_D = mean over pixels of c α |E / z - 1|

with the expected depth E and the opacity α of the LR render, and depth z and confidence c of stereo; c = 0 where z is unknown.
α weighs only, so that faint pixels do not count; the gradient reaches E alone. It takes part wherever the LR loss does: in the
training views and in the pseudo views.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Scalar
from clear_strategies.core.view import DepthMap
from clear_strategies.data.scene import Scene
from clear_strategies.errors import SettingError
from clear_strategies.training.field import FieldShot
from rasterizers.interface import Rasterizer, SplatGradients

_log = logging.getLogger(__name__)

LOSS: Final = "loss_depth"
"""The column of the history: L_D of the iteration's training view, unweighted."""


@dataclass(frozen=True, slots=True)
class DepthLoss:
    """The depth loss of LR renders.

    Args:
        weight: λ_D >= 0, of L_D beside L_LR; 0: no depth is drawn.

    Raises:
        SettingError: the weight is negative.
    """

    weight: float = 0.0

    def __post_init__(self) -> None:
        if not self.weight >= 0:
            raise SettingError(f"weight must be >= 0, got {self.weight}.")

    def of_run(self, scene: Scene, rasterizer: Rasterizer, *, draws_lr: bool) -> DepthLoss:
        """The same, or none and a warning, where it can have no effect.

        Args:
            draws_lr: whether the run renders LR.
        """
        if self.weight == 0:
            return self
        if not any(view.depth is not None and bool(view.depth.known.any()) for view in scene.train):
            why = "no training photo has stereo depth (data.cloud.init=stereo)"
        elif not rasterizer.traits.depth:
            why = f"the rasterizer {type(rasterizer).__name__} draws no depth"
        elif not draws_lr:
            why = "the run renders no LR"
        else:
            return self
        _log.warning("depth_loss has no effect: %s.", why)
        return DepthLoss(0.0)

    def added(self, shot: FieldShot, known: DepthMap) -> Scalar:
        """Let the shot's VJP return the gradient of λ_D L_D too; returns L_D.

        Args:
            shot: rendered with depth, at the size of `known`; its VJP is then asked for one cotangent.
        """
        if shot.depth is None:
            raise ValueError("a depth loss needs a shot that was rendered with depth.")
        usable = known.known & (shot.depth > 0)
        z = torch.where(usable, known.depth, 1.0)
        weight = torch.where(usable, known.confidence * shot.alpha, 0.0) / z.numel()
        error = shot.depth / z - 1
        cotangent = self.weight * weight * error.sign() / z
        of_image = shot.gradients

        def gradients(cotangents: Float[Tensor, "1 H W 3"]) -> SplatGradients:
            return of_image(torch.cat((cotangents, cotangent[None, ..., None]), dim=-1))

        shot.gradients = gradients
        return deferred.scalar((weight * error.abs()).sum())
