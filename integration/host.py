"""What an adapter tells an `Attachment` of a host, the trainer that stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from jaxtyping import Int
from torch import Tensor

from clear_strategies.core.checks import require_whole
from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.errors import HostError


@dataclass(frozen=True, slots=True, eq=False)
class Host:
    """A trainer, as its adapter describes it.

    Args:
        params: returns the leaves that the host optimizes, by gsplat's names (and "detail"). It is called at every
            iteration, since densifiers replace parameters.
        poll_parents: called at every iteration. Returns parents[M] if the structure has changed since the last call: row i of
            every parameter now comes from row parents[i], or is new if that is -1. Returns None if it has not changed, or the
            host does not say how.
        restart_parents: called after the host has loaded other parameters, whose rows come from no earlier ones.
        remedy: the end of the error message if strategies store something for each Gaussian, but some Gaussians are new.
        threshold: the host's densification threshold, on the mean ‖∇_u‖ in NDC units; None: the host reads no score.
        loss_scale: returns the factor of the loss (`scaler.get_scale` of an AMP gradient scaler).
        accumulation: backward passes per optimizer step, if the host divides each loss by this number; schedules then count
            steps. 1: the host does not divide; schedules count views.
        masks: [h, w] by the name of a view. The host multiplies its LR image by the mask; the HR image is multiplied here.
        own_background: True if the host chooses the colour behind its renderings; `Attachment.background` then has no effect.
        iterations: length of the loop, if it is known.

    Raises:
        SettingError: `accumulation` is not a whole number >= 1.
    """

    params: Callable[[], Mapping[str, Tensor]]
    poll_parents: Callable[[], Int[Tensor, " M"] | None]
    restart_parents: Callable[[], None] = lambda: None
    remedy: str = "End densification first."
    threshold: float | None = None
    loss_scale: Callable[[], float] | None = None
    accumulation: int = 1
    masks: Mapping[str, Tensor] = field(default_factory=dict)
    own_background: bool = True
    iterations: int | None = None

    def __post_init__(self) -> None:
        require_whole("accumulation", self.accumulation, least=1)

    def leaves(self) -> Mapping[str, Tensor]:
        """The parameters now.

        Raises:
            HostError: one of them is missing, or was computed from other tensors, so that its `.grad` would be lost.
        """
        params = self.params()
        if missing := [name for name in PARAMETERS if name not in params]:
            raise HostError(f"params must return {', '.join(PARAMETERS)}, got none of the name {missing[0]}.")
        require_leaves(params)
        return params

    def scale(self) -> float:
        """The factor of the gradients of one backward pass. A gradient scaler reads its own from the device."""
        return (1.0 if self.loss_scale is None else self.loss_scale()) / self.accumulation


def require_leaves(params: Mapping[str, Tensor]) -> None:
    """Raise a HostError if torch would give the gradient of a parameter to another tensor."""
    for name, p in params.items():
        if p.requires_grad and not p.is_leaf:
            raise HostError(
                f"{name} must be a leaf, whose .grad becomes the merged gradient, but it was computed from other tensors (a "
                "slice or a product of a parameter, torch.func.functional_call). Make it a Parameter of its own, and compute "
                "with that in the call of the renderer."
            )
