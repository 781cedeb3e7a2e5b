"""FadingOpacity: every Gaussian fades a little in each iteration, unless a loss raises its opacity again.

Without it, a Gaussian that no training view needs keeps its opacity: it floats in free space, or lies beyond the border of a
photo, and test views show it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.step import Step
from clear_strategies.schedules import milestone
from clear_strategies.strategies.base import Strategy

_log = logging.getLogger(__name__)

_FEW_VIEWS: Final = 3  # the whole rate is for runs with at most so many views,
_LONG_RUN: Final = 1_350  # that fade for at least so many iterations
_LOWEST: Final = -11.5  # an opacity of 1e-5: no renderer draws it, and no gradient reaches it


@dataclass(frozen=True)
class FadingOpacity(Strategy):
    """Opacity × (1 - rate) after each iteration.

    Args:
        rate: share of its opacity that a Gaussian loses in an iteration, in [0, 1). It is for three training views; with more
            views it is lower in proportion, so that a Gaussian fades equally between two iterations of one view. It is also
            lower in proportion if `until` is less than 1,350: opacities start low, and a short run must first raise them.
        until: the last iteration in which opacities fade.
        most: all iterations together fade by no more than so many at the whole rate; 0: no bound. By default 1,350 in other
            trainers, where nothing moves what has faded, as `mcmc` does: more turns surfaces into fog.

    Raises:
        SettingError: a setting is outside its range.
    """

    rate: float = 0.005
    until: int = milestone(9_000)
    most: int = 0

    def __post_init__(self) -> None:
        require_number("rate", self.rate, below=1)
        require_whole("most", self.most, least=0)

    def on_fit_start(self, n_views: int, seed: int) -> None:
        super().on_fit_start(n_views, seed)
        share = min(1.0, _FEW_VIEWS / max(1, n_views)) * min(1.0, self.until / _LONG_RUN)
        share = min(share, self.most / max(1, self.until)) if self.most else share
        self.cache["rate"] = self.rate * share
        if share < 1:
            _log.debug("opacities fade by %.5f an iteration instead of %.5f (%d views, until t=%d).",
                       self.rate * share, self.rate, n_views, self.until)  # fmt: skip

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        """The logit of (1 - rate) σ(o), which is log(1 - rate) - log(rate + exp(-o))."""
        rate: float = self.cache.get("rate", self.rate)
        if step.t > self.until or rate == 0:
            return
        o = params["opacities"]
        faded = math.log(1 - rate) - torch.log(rate + torch.exp(-o))
        o.copy_(torch.where(o > _LOWEST, faded, o))

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        return "no opacity fades: its rate is 0" if self.rate == 0 else None
