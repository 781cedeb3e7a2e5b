"""Steps on extra views: pictures that strategies want the field to match besides the iteration's own view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from clear_strategies.core.deferred import Number
from clear_strategies.core.finite import require_finite
from clear_strategies.core.view import ExtraView
from clear_strategies.training.state import TrainState
from rasterizers.interface import Rasterizer

LOSS: Final = "loss_extra"
"""The column of the history: the LR loss of the iteration's last extra view."""


def extra_steps(s: TrainState, rasterizer: Rasterizer, extra_views: Sequence[ExtraView]) -> dict[str, Number]:
    """One step of the optimizer on the LR loss of each; returns `LOSS`, or nothing without extra views.

    Raises:
        DivergedError: a loss or a gradient is not finite; that step was not made.
    """
    row: dict[str, Number] = {}
    θ, steps, where = s.field, s.optimizer.steps, f"t={s.t}, an extra view: the gradient"
    for extra in extra_views:
        with s.conductor.work_log.stage("extra views"):
            shot = θ.shot(rasterizer, extra.photo.camera)
            losses = s.conductor.extra_loss(shot.image, extra, s.t)
            if s.compiled_step is not None:
                (g,) = s.compiled_step.vjp(shot, losses.cotangents)
                require_finite(where, g.table())
                s.compiled_step.step_extra(θ.raw(), g, s.t)
            else:
                (grads,) = shot.vjp(losses.cotangents)
                require_finite(where, grads)
                s.optimizer.step(θ.raw(), grads)
                θ.constrain()
            s.optimizer.steps = steps  # the learning rates follow the iteration
            row[LOSS] = losses.values["lr"]
    return row
