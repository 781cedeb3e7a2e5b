"""The results of an iteration: the gradients of HR, the merged gradients and the update."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.deferred import Number, Scalar
from clear_strategies.core.finite import require_finite
from clear_strategies.core.gradients import Grads
from clear_strategies.core.step import Step
from clear_strategies.core.view import Photo, View
from rasterizers.guards import unread

VJP = Callable[..., Sequence[Grads]]
"""The gradients of a rendering's first argument, a `Shot`, as by `Shot.vjp`: of raw parameters, or of what is drawn."""

LossWeights = tuple[float, float] | Tensor
"""λ_HR(t) and λ_HR(t) λ_HF: two numbers, or a tensor of them on the device, [2]."""


@dataclass(frozen=True, slots=True, eq=False)
class HrSide:
    """The HR side of one view: its gradients, the evidence and the routing weights.

    Args:
        g: g^HR, with the `.screen` of ∇L_base.  Eq. 13
        detail: m λ_HF ∇L_HF of f_det, which L_base does not move and nothing corrects, with the `.screen` of ∇L_HF; None if
            λ_HF = 0.
        size: (width, height) of the image in whose pixels `.screen` counts.
        step: the iteration, with the answer of `observe`. m: the answer of `route`, [N] or 1.
        losses: L_base and L_HF by name; of a replay in a host, numbers that are not read yet.
        lr: ∇(λ_LR L_LR), if it passes through the HR render; else None.
    """

    g: Grads
    detail: Grads | None
    size: tuple[int, int]
    step: Step
    m: float | Float[Tensor, " N"] = 1.0
    losses: Mapping[str, Number] = field(default_factory=dict)
    lr: Grads | None = None

    @property
    def routed(self) -> Grads:
        """g^HR, and the gradient of f_det."""
        return Grads({**self.g, **(self.detail or {})}, colour=self.g.colour)


class Merged(NamedTuple):
    """One view's gradients, merged.

    Args:
        grads: g_LR + λ_HR ĝ_HR + λ∇L_stab, for the optimizer.  Eq. 8, 16
        conflict: share of Gaussians in conflict before correction, by group and as "gaussian".
        finite: whether all of `grads` is finite; on a device, a number that is not read yet.
    """

    grads: Grads
    conflict: Mapping[str, Number]
    finite: Number


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """The result of `Conductor.update`.

    Args:
        step: the iteration, for `Conductor.after_step`.
        grads: the merged gradient by attribute, for the optimizer; None before the merge.
        score: S_i, the statistic that densification uses; `ordinary` is that of 3DGS, without strategies. None if no
            densification reads them.
        conflict: share of Gaussians in conflict before correction, by group and as "gaussian"; empty without HR and before
            the merge.
        losses: scalars by name.
        cotangents_lr: the gradient of λ_LR L_LR with respect to the LR image, [1, H, W, 3].

    On a device, losses and conflict become floats by `deferred.read`.
    """

    step: Step
    grads: Grads | None
    score: Float[Tensor, " N"] | None
    ordinary: Float[Tensor, " N"] | None
    conflict: Mapping[str, Number] = field(default_factory=dict)
    losses: Mapping[str, Scalar] = field(default_factory=dict)
    cotangents_lr: Float[Tensor, "1 H W 3"] | None = None


def require_finite_parts(where: str, g_lr: Grads, hr: HrSide | None) -> None:
    """Check what is merged: gradients, evidence and routing weights; those on a device are not read."""
    parts: dict[str, Mapping[str, Tensor]] = {}
    if hr is not None:  # evidence and weights first, since the gradients contain them
        weights = {} if hr.step.evidence is None else {"reliability": hr.step.evidence.reliability}
        parts["the evidence"] = weights | ({"m": hr.m} if isinstance(hr.m, Tensor) else {})
        parts |= {"∇L_HR": hr.g.tensors} | ({} if hr.detail is None else {"∇L_HF": hr.detail.tensors})
    parts["∇L_LR"] = g_lr.tensors
    for part, tensors in parts.items():
        require_finite(f"{where}: {part}", tensors)


def guarded(view: View, *, over_changing: bool) -> View:
    """The view that strategies get in a recording. They may read only its images, which are copied before each replay.

    Args:
        over_changing: a strategy chooses the background, so transparent images differ between replays.
    """

    def layer(x: Any, what: str) -> Any:
        return None if x is None else unread(x, f"the {what} of the view", ("shape", "dtype"))

    def photo(p: Photo) -> Photo:
        image = layer(p.image, "transparent image") if over_changing and p.transparency is not None else p.image
        camera = unread(p.camera, "the camera of the view", ("width", "height"))
        return replace(p, camera=camera, image=image, transparency=layer(p.transparency, "transparency"))

    named = {name: unread(getattr(view, name), f"the {name} of the view") for name in ("name", "sr_source")}
    layers = {name: layer(getattr(view, name), name) for name in ("truth", "depth", "disagreement")}
    return replace(view, lr=photo(view.lr), hr=photo(view.hr), **named, **layers)
