"""For a loop that you edit: a loss whose gradient is the merged gradient of both scales.

The host keeps `loss.backward()` and everything after it: optimizer, gradient scaler, accumulation, densifier. For a loop
that must stay as it is, see attachment.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.deferred import Scalar
from clear_strategies.core.gradients import Grads, Shot
from clear_strategies.core.view import ExtraView, View
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import Update
from integration.autograd_shot import AutogradShot
from integration.densification import ScoreScaler, score_for_host


def joint_loss(
    conductor: Conductor,
    params: Mapping[str, Tensor],
    lr: Shot,
    hr: Shot | None,
    view: View,
    t: int,
    scaler: ScoreScaler | None = None,
) -> tuple[Float[Tensor, ""], Update]:
    """λ_LR L_LR + λ_HR (L_base + λ_HF L_HF), whose gradient is the conductor's merged gradient, and what was decided.

    Args:
        params: the leaves that the host optimizes, by gsplat's names (and "detail", if the host has it).
        lr, hr: the renderings of this view at both scales, e.g. `AutogradShot`. t: the iteration, from 1.
        scaler: for hosts with a densifier; `backward()` then also writes the score where the densifier reads the screen
            gradient.

    Returns:
        The loss, and the `Update`: the step for `Conductor.after_step`, densification scores, conflict ratios.
    """
    values = {name: p.detach() for name, p in params.items()}
    update = conductor.update(values, lr, hr, view, t)
    objective, λ = conductor.objective, conductor.objective.lambda_hr(t)
    losses = update.losses
    value = objective.lambda_lr * losses["lr"] + λ * (
        losses.get("base", 0.0) + objective.lambda_hf * losses.get("hf", 0.0)
    )
    merged = update.grads or Grads()
    trained = {name: p for name, p in params.items() if name in merged}
    gradients = [merged[name].to(p) for name, p in trained.items()]

    loss: Tensor = _GivenGradients.apply(value, gradients, *trained.values())  # type: ignore[no-untyped-call]
    if scaler is not None and isinstance(lr, AutogradShot):
        slot, (own, ordinary) = lr.gradient_slot, (update.score, update.ordinary)
        score = None if own is None or ordinary is None else score_for_host(slot, own, ordinary, lr.visible, scaler)
        if score is not None:
            loss.register_hook(lambda loss_scale: slot.write(loss_scale * score))  # type: ignore[no-untyped-call]
    return loss, update


def extra_loss(conductor: Conductor, image: Float[Tensor, "h w 3"], extra: ExtraView, t: int) -> Float[Tensor, ""]:
    """λ_LR L_LR of an extra view, weighted by pixel.

        for extra in conductor.extra_views(t):
            optimizer.zero_grad()
            extra_loss(conductor, render(extra.photo.camera), extra, t).backward()
            optimizer.step()

    Args:
        image: rendered by the camera of `extra`, without a gate and without f_det.
    """
    losses = conductor.extra_loss(image, extra, t)
    value = conductor.objective.lambda_lr * losses.values["lr"]
    loss: Tensor = _GivenGradients.apply(value, [losses.cotangents[0]], image)  # type: ignore[no-untyped-call]
    return loss


class _GivenGradients(torch.autograd.Function):
    """A scalar whose gradients are given; scaling the loss scales them."""

    @staticmethod
    def forward(ctx: Any, value: Scalar, gradients: list[Tensor], *params: Tensor) -> Tensor:
        ctx.gradients = gradients
        return torch.as_tensor(value, dtype=params[0].dtype, device=params[0].device)

    @staticmethod
    def backward(ctx: Any, *loss_scale: Tensor) -> Any:
        return None, None, *(g * loss_scale[0] for g in ctx.gradients)
