"""PSNR of training and test views while training."""

from __future__ import annotations

import math
from typing import Final

from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.data.scene import Scene
from clear_strategies.training.state import TrainState
from rasterizers.interface import Rasterizer

_STAGE: Final = "probe test views"


def evaluate(state: TrainState, scene: Scene, rasterizer: Rasterizer, done: int) -> None:
    """Add the mean PSNR of the first few test views, as far as their HR photos are known, to the last row of the history."""
    work_log = state.conductor.work_log
    if state.reset_due(done) and not state.ended:
        work_log.skip(_STAGE, "opacities were reset in this iteration")
        return
    with work_log.stage(_STAGE):
        values = [
            psnr_of(state.field.render(rasterizer, view.hr.camera), truth, view.hr.shown)
            for view in scene.test[: state.settings.probe_views]
            if (truth := view.true_hr) is not None and view.lr.visible.any()
        ]
        if values:
            state.history[-1]["psnr_test"] = sum(deferred.read(values)) / len(values)


def loss_of_views(state: TrainState, rasterizer: Rasterizer) -> Number:
    """Mean loss of training views against what they are trained on, every Gaussian drawn.

    A training loss is no measure of progress: dropout changes it, and so does the order of the views.
    """
    objective, losses = state.conductor.objective, []
    for view in state.views:
        shown, compare, name = view.lr, objective.lr, "lr"
        if objective.lambda_hr(state.t) > 0:
            shown, compare, name = state.conductor.skips.view(view, state.t).hr, objective.hr, "base"
        image = state.field.render(rasterizer, shown.camera)
        losses.append(compare(image, shown.image, shown.shown).values[name])
    return sum(losses) / len(losses)


def psnr_of(image: Tensor, target: Tensor, shown: Tensor | None) -> Number:
    """dB, of the shown pixels."""
    squared = image.clamp(0, 1).sub_(target).square_()
    mse = squared.mean() if shown is None else (squared.mean(2) * shown).sum() / shown.sum().clamp_min(1)
    return deferred.defer(lambda mse: -10 * math.log10(max(mse, 1e-10)), deferred.scalar(mse))
