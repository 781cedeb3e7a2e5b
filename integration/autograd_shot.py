"""What a host renders, as a `Shot`: gradients come from `torch.autograd.grad` through the host's own graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.gradients import Grads
from rasterizers.interface import Camera


@dataclass(frozen=True, slots=True, eq=False)
class ScreenGradientSlot:
    """The tensor in which a host keeps the screen gradient ∇_u, the gradient of the projected centres.

    Args:
        tensor: [N, 2 or more]. It may have leading dimensions of 1 (hosts that batch views), or one row per entry of
            `rows` (hosts that pack visible Gaussians).
        size: (width, height) of the image in pixels.
        to_pixels: factors from the tensor's gradient to a gradient in 1/pixel: (1, 1) in gsplat, whose tensor is in
            pixels; (2 / width, 2 / height) in 3DGS, whose tensor is in NDC.
        rows: the Gaussian of each row; None: row i is Gaussian i.
        ranked: a column after the second that the host only ranks Gaussians by (Mip-Splatting's absolute gradient).
    """

    tensor: Tensor
    size: tuple[int, int]
    to_pixels: tuple[float, float] = (1.0, 1.0)
    rows: Int[Tensor, " M"] | None = None
    ranked: int | None = None

    def per_gaussian(self, gradient: Tensor, n: int) -> Float[Tensor, "N 2"]:
        """∇_u of all N Gaussians in 1/pixel, from a gradient of the tensor."""
        g = gradient.reshape(-1, gradient.shape[-1])[:, :2] * gradient.new_tensor(self.to_pixels)
        return g if self.rows is None else g.new_zeros(n, 2).index_add_(0, self.rows, g)

    def absgrad(self, n: int) -> Float[Tensor, "N 2"] | None:
        """Σ|∂L/∂u| over pixels of all N Gaussians in 1/pixel; None: the host does not keep gsplat's `absgrad`."""
        absgrad = getattr(self.tensor, "absgrad", None)
        return None if absgrad is None else self.per_gaussian(absgrad, n)

    def write(self, norms: Float[Tensor, " N"]) -> None:
        """Set the tensor's `.grad` (and gsplat's `.absgrad`) so that its row norms in NDC units are `norms`.

        Columns after the second keep the host's values, some store absolute gradients there; only `ranked` is written too.
        """
        gradient = torch.zeros_like(self.tensor)
        if self.tensor.grad is not None:
            gradient[..., 2:] = self.tensor.grad[..., 2:]
        rows = norms if self.rows is None else norms[self.rows]
        gradient.view(-1, gradient.shape[-1])[:, 0] = rows.to(gradient) * (2 / self.size[0] / self.to_pixels[0])
        if self.ranked is not None:
            gradient[..., self.ranked] = gradient[..., 0]
        self.tensor.grad = gradient
        if hasattr(self.tensor, "absgrad"):
            self.tensor.absgrad = gradient


@dataclass(frozen=True, slots=True, eq=False)
class AutogradShot:
    """A rendering by a host, differentiable by autograd.

    Args:
        image: a function of `params` and of the tensor that holds the screen gradient.
        means2d: projected centres in pixels.
        visible: Gaussians that contribute to the image.
        params: raw parameters by gsplat's names. A parameter that the image does not depend on has gradient 0.
        slot: where the host keeps the screen gradient; None: the image is a function of `means2d` itself.
    """

    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    params: Mapping[str, Tensor]
    slot: ScreenGradientSlot | None = None

    @property
    def gradient_slot(self) -> ScreenGradientSlot:
        """`slot`, or `means2d` as one."""
        return self.slot or ScreenGradientSlot(self.means2d, (self.image.shape[1], self.image.shape[0]))

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        """One backward pass through the host's graph per cotangent; the graph is kept. Frozen parameters have gradient 0."""
        slot, trained = self.gradient_slot, {name: p for name, p in self.params.items() if p.requires_grad}
        frozen = {name: torch.zeros_like(p) for name, p in self.params.items() if name not in trained}
        projected = [slot.tensor] if slot.tensor.requires_grad else []  # gsplat's 3DGUT draws without projected centres
        results = []
        for cotangent in cotangents:
            gradients = torch.autograd.grad(
                self.image, [*trained.values(), *projected], cotangent, retain_graph=True, allow_unused=True,
                materialize_grads=True,
            )  # fmt: skip
            values = frozen | dict(zip(trained, gradients, strict=False))
            screen = gradients[-1] if projected else torch.zeros_like(slot.tensor)
            results.append(Grads(values, screen=slot.per_gaussian(screen, len(self.visible))))
        return results


Target = Literal["lr", "hr"] | Camera
"""What a host draws: the view of this iteration at one of its sizes, or what a camera without a photo sees."""


@dataclass(frozen=True, slots=True, eq=False)
class HostOutput:
    """What a host's render function returned, as its adapter passes it to an `Attachment`.

    Args:
        hooked: a tensor that the host computes its loss from. Its gradient marks the start of the host's backward pass.
        returned: what the host's own render function returns.
    """

    shot: AutogradShot
    hooked: Tensor
    returned: Any


RenderAt = Callable[[Target, Float[Tensor, " N"] | None], HostOutput]
"""Renders by the host's own renderer, opacities multiplied by the gate: with f_det at HR, without it for any other target."""
