"""The loop that can be edited: a host's rendering as a `Shot`, and a scalar whose gradient is the merged gradient.

Three added lines, see README.md. The host keeps `loss.backward()` and everything after it: its optimizer, its gradient
scaler, its accumulation, its densifier. A loop that must stay as it is: `attach.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.deferred import Scalar
from clear_strategies.core.gradients import Grads, Shot
from clear_strategies.merging.conductor import Conductor, Update
from integration.densify import Scale, Screen, to_read


@dataclass(frozen=True, slots=True, eq=False)
class AutogradShot:
    """A rendering made by a host.

    Args:
        image: in the graph of `params` and of the tensor that holds ∇_u.
        means2d: projected centres, pixels.
        params: raw parameters by gsplat's names; one that the image does not depend on has gradient 0.
        screen: where the host keeps ∇_u; None: `means2d` itself is in the graph.
    """

    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    params: Mapping[str, Tensor]
    screen: Screen | None = None

    @property
    def kept(self) -> Screen:
        """Where ∇_u is kept."""
        return self.screen or Screen(self.means2d, (self.image.shape[1], self.image.shape[0]))

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        """One pass through the host's graph for each cotangent; the graph is kept."""
        inputs = [*self.params.values(), self.kept.tensor]
        pulled = []
        for cotangent in cotangents:
            *gradients, screen = torch.autograd.grad(
                self.image, inputs, cotangent, retain_graph=True, allow_unused=True, materialize_grads=True
            )
            values = dict(zip(self.params, gradients, strict=True))
            pulled.append(Grads(values, screen=self.kept.gradient(screen, len(self.visible))))
        return pulled


def joint_loss(
    conductor: Conductor,
    params: Mapping[str, Tensor],
    lr: Shot,
    hr: Shot | None,
    view: Any,
    t: int,
    scale: Scale | None = None,
) -> Float[Tensor, ""]:
    """λ_LR L_LR + λ_HR (L_base + λ_HF L_HF) by value; its gradient is the conductor's merged one.

    Args:
        params: the leaves that the host optimizes, by gsplat's names (and "detail", if it has one).
        lr, hr: this view rendered at both scales, e.g. as `AutogradShot`. view: see `clear_strategies.core.view.View`.
        scale: given the host's densification threshold, `backward()` also leaves the score where the host's densifier
            reads ∇_u of the LR rendering.
    """
    return joint_update(conductor, params, lr, hr, view, t, scale)[0]


def joint_update(
    conductor: Conductor,
    params: Mapping[str, Tensor],
    lr: Shot,
    hr: Shot | None,
    view: Any,
    t: int,
    scale: Scale | None = None,
) -> tuple[Float[Tensor, ""], Update]:
    """`joint_loss`, with the `Update` behind it: scores for a densifier of one's own, conflict ratios for the log."""
    values = {name: p.detach() for name, p in params.items()}
    update = conductor.update(values, lr, hr, view, t)
    objective, λ = conductor.objective, conductor.objective.lambda_hr(t)
    losses = update.losses
    value = objective.lambda_lr * losses["lr"] + λ * (
        losses.get("base", 0.0) + objective.lambda_hf * losses.get("hf", 0.0)
    )
    merged = update.grads or Grads()
    touched = {name: p for name, p in params.items() if name in merged}
    gradients = [merged[name].to(p) for name, p in touched.items()]

    kept = lr.kept if scale is not None and isinstance(lr, AutogradShot) else None
    read = None if kept is None else to_read(kept, update.score, update.ordinary, lr.visible, scale)

    def densify(times: Float[Tensor, ""]) -> None:
        if kept is not None and read is not None:
            kept.hand_over(times * read)

    loss: Tensor = _GivenGradients.apply(value, gradients, densify, *touched.values())  # type: ignore[no-untyped-call]
    return loss, update


class _GivenGradients(torch.autograd.Function):
    """A scalar with gradients that were computed elsewhere; scaling the loss scales them."""

    @staticmethod
    def forward(
        ctx: Any, value: Scalar, gradients: list[Tensor], densify: Callable[[Tensor], None], *params: Tensor
    ) -> Tensor:
        ctx.gradients, ctx.densify = gradients, densify
        return torch.as_tensor(value, dtype=params[0].dtype, device=params[0].device)

    @staticmethod
    def backward(ctx: Any, *times: Tensor) -> Any:
        ctx.densify(times[0])
        return None, None, None, *(g * times[0] for g in ctx.gradients)
