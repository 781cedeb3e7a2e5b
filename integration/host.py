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
        poll_parents: called at every iteration. It returns parents[M] if the structure has changed since its last call (row i of
            every parameter now comes from row parents[i], or from none if that is -1); None: it has not, or the host does not
            say how.
        restart_parents: called after the host has loaded other parameters, which come from no earlier ones.
        remedy: for the error if strategies store something per Gaussian, but some Gaussians come from no other.
        threshold: on the mean ‖∇_u‖ in NDC units, by which the host densifies; None: it reads no score.
        loss_scale: returns the factor of the loss (`scaler.get_scale` of an AMP gradient scaler).
        accumulation: backward passes per optimizer step, if the host divides each loss by this number, and the schedules count
            steps; 1: it sums the losses of several views, or a step has only one, and they count views.
        masks: [h, w] by the name of a view, by which the host multiplies its LR image; the HR image is multiplied here.
        own_background: the host chooses the colour behind its renderings, and `Attachment.background` has no effect.
        iterations: of the loop, if they are known.

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
