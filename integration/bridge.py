"""Two small pieces that turn any autograd-based renderer into a host.

`AutogradShot` pulls gradients through the host's own graph; `joint_loss` is a scalar whose value is the honest loss and
whose `backward()` hands every parameter its merged gradient, so that the host keeps its optimizer, its gradient scaler
and its accumulation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.conductor import Conductor, Update
from clear_strategies.gradients import Grads, Shot


@dataclass(frozen=True, slots=True, eq=False)
class AutogradShot:
    """A rendering made by a host.

    Args:
        image: in the graph of `params` and of `means2d`.
        means2d: projected centres, pixels; a tensor that `image` was computed from.
        params: raw parameters by gsplat's names; one that the image does not depend on has gradient 0.
    """

    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    params: Mapping[str, Tensor]

    def pull(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        """One pass through the host's graph for each cotangent; the graph is kept."""
        inputs = [*self.params.values(), self.means2d]
        pulled = []
        for cotangent in cotangents:
            gradients = torch.autograd.grad(
                self.image, inputs, cotangent, retain_graph=True, allow_unused=True, materialize_grads=True
            )
            pulled.append(Grads(dict(zip(self.params, gradients, strict=False)), screen=gradients[-1]))
        return pulled


def joint_loss(
    conductor: Conductor, params: Mapping[str, Tensor], lr: Shot, hr: Shot | None, view: Any, t: int
) -> Float[Tensor, ""]:
    """λ_LR L_LR + λ_HR (L_base + λ_HF L_HF) by value; its gradient is the conductor's merged one.

    Args:
        params: the leaves that the host optimizes, by gsplat's names (and "detail", if it has one).
        lr, hr: this view rendered at both scales, e.g. as `AutogradShot`. view: see `clear_strategies.data.view.View`.
    """
    return joint_update(conductor, params, lr, hr, view, t)[0]


def joint_update(
    conductor: Conductor, params: Mapping[str, Tensor], lr: Shot, hr: Shot | None, view: Any, t: int
) -> tuple[Float[Tensor, ""], Update]:
    """`joint_loss`, with the `Update` behind it: scores for the host's densifier, conflict ratios for its log."""
    values = {name: p.detach() for name, p in params.items()}
    update = conductor.update(values, lr, hr, view, t)
    objective, λ = conductor.objective, conductor.objective.lambda_hr(t)
    losses = update.losses
    value = objective.lambda_lr * losses["lr"] + λ * (
        losses.get("base", 0.0) + objective.lambda_hf * losses.get("hf", 0.0)
    )
    touched = {name: p for name, p in params.items() if name in update.grads}
    gradients = [update.grads[name].to(p) for name, p in touched.items()]
    loss: Tensor = _GivenGradients.apply(value, gradients, *touched.values())  # type: ignore[no-untyped-call]
    return loss, update


class _GivenGradients(torch.autograd.Function):
    """A scalar with gradients that were computed elsewhere; scaling the loss scales them."""

    @staticmethod
    def forward(ctx: Any, value: float, gradients: list[Tensor], *params: Tensor) -> Tensor:
        ctx.gradients = gradients
        return params[0].new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *scale: Tensor) -> Any:
        return None, None, *(g * scale[0] for g in ctx.gradients)
