"""SVS: sparse-view stabilization.  Eq. 15, 16

One dropout mask, shared by both scales, keeps Gaussians from co-adapting without making LR and HR
disagree. Once densification has ended, an anchor pulls the field towards its state at that moment.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import refuse, require_choice, require_number, require_whole
from clear_strategies.core.gradients import ATTRIBUTES, Grads
from clear_strategies.core.points import spread
from clear_strategies.core.seeds import dropout_mask
from clear_strategies.core.step import Step
from clear_strategies.errors import AnchorError, counted
from clear_strategies.schedules import Ramp, milestone
from clear_strategies.strategies.base import Strategy
from rasterizers.native import empty_for

_log = logging.getLogger(__name__)

# Geometry is held, appearance may still be refined (F40). f_det is held wherever the base colour is, else it drifts (F35).
ANCHOR_WEIGHTS: Final[Mapping[str, float]] = {
    "means": 1e-4, "scales": 1e-4, "quats": 1e-4, "opacities": 1e-5, "sh0": 1e-6, "shN": 1e-6, "detail": 1e-6,
}  # fmt: skip


@dataclass(frozen=True)
class SVS(Strategy):
    """Shared dropout, then an anchor.

    Args:
        dropout: p_t, the share of Gaussians dropped at iteration t.
        looks: how often each training view must be seen until `dropout.full` for the whole rate; a run that sees them
            less often over-fits less, and its rate is lowered in proportion. 0: the rate is never lowered (F37).
        anchor_start: t_a, the iteration at which densification stops and the anchor is taken.
        anchor_strength: λ_stab >= 0; 0 takes no anchor (densification still stops at t_a); the paper's is 0.01 (F40).
        anchor_weights: W by attribute, >= 0, on raw parameters; positions count in units of the extent of the anchored
            cloud (90th percentile of the distance from its median).
        shared: both scales drop the same Gaussians. False, for experiment=claims and not in the paper: each scale drops its own;
            the step is then not compiled, and other trainers refuse it.
        reduction: "sum" over Gaussians as printed in the paper, or their "mean" (negligible for 1e5 Gaussians).

    Raises:
        SettingError: a setting is outside its range.
        AnchorError: (while training) the number of Gaussians changed after t_a.
    """

    dropout: Ramp = field(default_factory=Ramp)
    looks: int = 1_000
    anchor_start: int = milestone(5_000)
    anchor_strength: float = 0.0
    anchor_weights: Mapping[str, float] = field(default_factory=lambda: dict(ANCHOR_WEIGHTS))
    reduction: Literal["sum", "mean"] = "sum"
    shared: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.dropout, Ramp):  # as a number, from Python
            refuse("dropout", "must be a Ramp", self.dropout, "dropout=Ramp(0.2)")
        require_whole("looks", self.looks, least=0)
        require_number("anchor_strength", self.anchor_strength)
        require_choice("reduction", self.reduction, ("sum", "mean"))
        for name, weight in self.anchor_weights.items():
            require_choice("anchor_weights", name, ATTRIBUTES)
            require_number(f"anchor_weights.{name}", weight)

    def on_fit_start(self, n_views: int, seed: int) -> None:
        super().on_fit_start(n_views, seed)
        n_views = max(1, n_views)
        # The share of the rate for a run that sees each view `dropout.full` / n_views times.
        self.cache["share"] = min(1.0, self.dropout.full / (self.looks * n_views)) if self.looks else 1.0
        if self.dropout.full == 0 and self.looks and self.dropout.maximum > 0:
            _log.warning(
                "SVS drops nothing: until svs.dropout.full=0 no training view is seen, and svs.looks=%d lowers the rate by that. "
                "Set svs.looks=0 for the whole rate from the first iteration on.", self.looks,
            )  # fmt: skip
        elif self.cache["share"] < 1 and self.dropout.maximum > 0:
            _log.debug(
                "dropout rises to %.3f instead of %.3f: each of the %s is seen %s (svs.looks: %d).",
                self.dropout.maximum * self.cache["share"], self.dropout.maximum, counted(n_views, "training view"),
                counted(self.dropout.full // n_views, "time"),
                self.looks,
            )  # fmt: skip

    @property
    def shares_gate(self) -> bool:
        return self.shared

    def gate(self, t: int, n: int) -> Float[Tensor, " N"] | Float[Tensor, "2 N"] | None:
        """zᵗ: 0 for dropped Gaussians, 1 / (1 - p_t) for the others; a function of (seed, t)."""
        p = self.dropout(t) * self.cache.get("share", 1.0)
        if p == 0:
            return None
        z = dropout_mask(n, p, self.seed, t, self.device)
        return z if self.shared else torch.stack((z, dropout_mask(n, p, ~self.seed, t, self.device)))

    def regularize(self, params: Mapping[str, Tensor], t: int) -> Grads | None:
        """∇ λ_stab Σ_i ‖θ_i - θ_i^a‖²_W, for every Gaussian, seen or not; None before the anchor.

        Raises:
            AnchorError: the number of Gaussians is not that of the anchor.
        """
        if not self.state:
            return None
        n = next(iter(params.values())).shape[0]
        self._require_same_number(n)
        strength = 2 * self.anchor_strength / (1 if self.reduction == "sum" else n)
        pull = Grads()
        for name in self.state.keys() & params.keys():
            unit = self._extent() ** 2 if name == "means" else 1.0
            difference = torch.sub(params[name], self.state[name], out=empty_for(params[name]))
            pull[name] = difference.mul_(strength * self.anchor_weights[name] / unit)  # Eq. 16
        return pull

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        if self.dropout.maximum == 0 and (self.anchor_strength == 0 or not any(self.anchor_weights.values())):
            return f"it drops nothing and anchors nothing, and only ends densification at t={self.anchor_start}"
        return None

    def may_densify(self, t: int) -> bool:
        return t < self.anchor_start

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        """Take the anchor θ^a = sg(θ(t_a)); the last structural change was at t < t_a."""
        if step.t >= self.anchor_start and self.anchor_strength > 0 and not self.state:  # skips may jump over t_a
            self.state.update(
                {
                    name: params[name].detach().clone()
                    for name, weight in self.anchor_weights.items()
                    if weight > 0 and name in params
                }
            )

    def on_resize(self, parents: Tensor) -> None:
        if self.state:
            self._require_same_number(len(parents))
        super().on_resize(parents)

    def _extent(self) -> float:
        means = self.state["means"]
        known: tuple[Tensor, float] | None = self.cache.get("extent")
        if known is None or known[0] is not means:  # a checkpoint may bring another anchor
            known = self.cache["extent"] = means, max(spread(means), torch.finfo(means.dtype).tiny ** 0.5)
        return known[1]

    def _require_same_number(self, n: int) -> None:
        anchored = next(iter(self.state.values())).shape[0]
        if n != anchored:
            raise AnchorError(
                f"the anchor was taken at t={self.anchor_start} for {anchored:,} Gaussians, now there are {n:,}. Stop "
                "densification at t_a (gsplat: refine_stop_iter; Inria: densify_until_iter) or raise "
                "strategies.svs.anchor_start."
            )
