"""The detail feature f_det in hosts, which have no such parameter: its Adam, its decay, and its offset of the colours."""

from __future__ import annotations

import logging
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.merging.detail import DetailRates
from rasterizers.geometry import SH_C0

_log = logging.getLogger(__name__)

DETAIL_EPS: Final = 1e-15
"""Adam's, as in 3DGS: gradients of mean losses are near 1e-6."""
_PATIENCE: Final = 10  # steps with a gradient of f_det, before a warning that none was made on it


def detail_adam(detail: torch.nn.Parameter, rates: DetailRates) -> torch.optim.Adam:
    """An Adam for f_det that steps all Gaussians. It drops the mask of visible ones that a loop may pass to all optimizers, as to
    gsplat's SelectiveAdam, since others are visible at HR.
    """
    fused = detail.device.type in ("cpu", "cuda")  # one operation
    adam = torch.optim.Adam([detail], lr=rates.rate, eps=DETAIL_EPS, fused=fused)
    adam.register_step_pre_hook(lambda _, args, kwargs: (
        tuple(value for value in args if not isinstance(value, Tensor)),
        {name: value for name, value in kwargs.items() if name != "visibility"},
    ))  # fmt: skip
    return adam


def sh0_offset(detail: Float[Tensor, "N 3"], sh0: Float[Tensor, "N ..."]) -> Float[Tensor, "N ..."]:
    """f_det as an offset of the constant SH band."""
    return (detail / SH_C0).view_as(sh0)


class Fading:
    """The decay of f_det in each step of the host in which HR takes part. L_HF does not change if a constant is added to the
    colours, so nothing else would keep the mean of f_det near 0.

    Attributes:
        passes: backward passes in which HR takes part, since the last step.
    """

    def __init__(self, rates: DetailRates) -> None:
        self._rates = rates
        self._detail: Tensor | None = None
        self.passes = 0
        self._steps = 0  # which had a gradient of f_det in their first pass

    def add_pass(self, detail: Tensor, *, is_learned: bool) -> None:
        """Count a backward pass in which HR takes part. Warns if f_det has not changed after several steps.

        Args:
            is_learned: whether the pass has a gradient of f_det; otherwise HR is rendered only for its scores.
        """
        if detail is not self._detail:  # a densifier has replaced it
            self.resume(detail, 0)
        begins = is_learned and self.passes == 0
        self.passes += 1
        self._steps += begins
        if begins and self._steps == _PATIENCE and self._rates.rate > 0 and not bool(detail.any()):
            _log.warning(
                "f_det has no effect: none of its first %d gradients was stepped on. Step the optimizer of the parameter detail: "
                "attach adds it to the optimizers that it is given, and one that is made anew must hold it, too.", _PATIENCE,
            )  # fmt: skip

    def resume(self, detail: Tensor | None, passes: int) -> None:
        """Continue from so many passes of a step."""
        self._detail, self.passes = detail, passes

    @torch.no_grad()
    def before_step(self, passes: int) -> None:
        """Apply the decay of a step of so many passes, of which each with HR adds an equal part."""
        if self._detail is not None and self.passes:
            self._detail.mul_((1 - self._rates.decay / passes) ** self.passes)
        self.passes = 0
