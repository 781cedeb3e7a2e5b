"""The detail feature f_det in hosts, which have no such parameter: its Adam, how it fades, and how it shows in the colours."""

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
    """An Adam for f_det that steps all Gaussians. A loop may pass it the visible ones, as gsplat's SelectiveAdam takes them: the
    argument is dropped, since others are visible at HR.
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
    """f_det loses a share of itself with each step of the host in which HR takes part. L_HF does not change with a constant
    added to the colours, so that nothing else would hold the mean of f_det.

    Args:
        passes: backward passes per step, which have equal parts of the share.
    """

    def __init__(self, rates: DetailRates, passes: int) -> None:
        self._rates, self._passes = rates, passes
        self._passed: list[Tensor] = []  # f_det in the passes since the last step
        self._gradients = 0

    def add_pass(self, detail: Tensor, *, is_learned: bool) -> None:
        """After a backward pass in which HR takes part, by its scores alone where f_det is not learned. Warns if f_det has not
        changed after the first gradients.
        """
        self._passed.append(detail)
        self._gradients += is_learned
        warns = is_learned and self._gradients == _PATIENCE * self._passes and self._rates.rate > 0
        if warns and not bool(detail.any()):
            _log.warning(
                "f_det has no effect: none of its first %d gradients was stepped on. Step the optimizer of the parameter detail: "
                "attach adds it to the optimizers that it is given, and one that is made anew must hold it, too.", _PATIENCE,
            )  # fmt: skip

    @torch.no_grad()
    def before_step(self) -> None:
        """The share of the passes since the last step is lost, of the tensor that they have given a gradient to."""
        for detail in self._passed:
            detail.mul_(1 - self._rates.decay / self._passes)
        self._passed.clear()

    def forget(self) -> None:
        """The host has dropped the passes since its last step, or skips the step."""
        self._passed.clear()
