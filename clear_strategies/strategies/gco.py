"""GCO: Gaussian-wise conflict-aware optimization.  Eq. 6, 7, 11

An HR gradient that conflicts with the authentic LR gradient is corrected until the cosine of the two
reaches the margin, for each Gaussian and each attribute group. LR gradients are never changed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.checks import refuse, require_choice, require_number
from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS
from clear_strategies.core.step import Step
from clear_strategies.kernels.native import times
from clear_strategies.strategies.base import Strategy

_log = logging.getLogger(__name__)

# The column of the share of corrections with ω at its lower bound: near 1, the prior agrees with LR.
_AT_LOWER_BOUND: Final = "omega_at_lower_bound"
_SCALES: Final = CONFLICT_GROUPS.index("scales")
_QUATS: Final = CONFLICT_GROUPS.index("quats")
_OPACITIES: Final = CONFLICT_GROUPS.index("opacities")
_TINY: Final = torch.finfo(torch.float64).tiny
# A Gaussian whose axes are equally long does not change when it is rotated: in exact arithmetic its rotation gradient is 0, in
# floating point it is noise that would "conflict" one time in five.
_ROTATION_NOISE: Final = 2.0**-18
_CANCELLED: Final = 2.0**-20  # ‖ĝ_HR‖² / ‖g_HR‖² at least: what is left of less is rounding, and not to be enlarged


@dataclass(frozen=True)
class GCO(Strategy):
    """Correct conflicting HR gradients.

    Args:
        tolerance: τ_c in [0, 1): cosines down to -τ_c are no conflict.
        weight_min, weight_max: bounds of ω where a conflict is corrected, 0 <= min <= max <= 1.
        groups: the attributes that are compared and corrected, each separately.
        whole: compare a Gaussian as a whole, all groups together. Not in the paper; see experiment=claims.
        drop: leave out a conflicting HR gradient instead of correcting it. Not in the paper; see experiment=claims.
        keep_length: without evidence, scale ĝ_HR to the length of g_HR. A gradient that opposes LR is then turned and not
            weakened, since nothing says that it is wrong; one that is exactly opposite, as in each conflict of opacities, stays
            as it is. False: as in the paper (F31).

    There is no ε: products are in float64, where those of float32 gradients do not vanish, and a zero norm is no conflict (F27).
    The opacity group has one dimension: its cosine is ±1, so every disagreement is a full conflict.
    Without evidence q = 0 (F32), by which the paper's formula leaves 0.29 of an opposite HR gradient.

    Raises:
        SettingError: a setting is outside its range.
    """

    tolerance: float = 0.05
    weight_min: float = 0.05
    weight_max: float = 0.75
    groups: Sequence[str] = CONFLICT_GROUPS
    whole: bool = False
    drop: bool = False
    keep_length: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "groups", tuple(self.groups))
        require_number("tolerance", self.tolerance, below=1)
        if not 0 <= self.weight_min <= self.weight_max <= 1:
            bounds = (self.weight_min, self.weight_max)
            refuse(
                "weight_min", "0 <= weight_min <= weight_max <= 1 must hold", bounds, "weight_min=0.05 weight_max=0.75"
            )
        if not self.groups:
            refuse("groups", "must name an attribute, or nothing is corrected", [], f"groups=[{CONFLICT_GROUPS[0]}]")
        for group in self.groups:
            require_choice("groups", group, CONFLICT_GROUPS)

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        if lambda_lr == 0:
            return "lambda_LR is 0, so nothing can conflict"
        return "lambda_HR is 0 throughout" if lambda_hr == 0 else None

    def reconcile(self, products: Products, step: Step | None) -> Weights:
        """ĝ_HR = g_HR - ω (c + τ_c) ‖h‖ / ‖l‖ g_LR where c < -τ_c. Logs what was corrected."""
        p, τ = products, self.tolerance
        dot, l2, h2 = map(self._together, (p.dot, p.l2, p.h2)) if self.whole else (p.dot, p.l2, p.h2)
        per_norm = times(l2, h2).clamp_min_(_TINY).rsqrt_()  # 1 / (‖l‖ ‖h‖)
        c = times(dot, per_norm)  # Eq. 6
        below = c.add_(τ).clamp_max_(0)  # c + τ_c, how far a cosine lies below the margin; 0: no conflict
        below[:, _QUATS] *= _turns_something(p.l2) & _turns_something(p.h2)
        for group in set(CONFLICT_GROUPS).difference(self.groups):  # an index that is a list waits for the device
            below[:, CONFLICT_GROUPS.index(group)].zero_()
        evidence = None if step is None else step.evidence
        keeps_length = self.keep_length and evidence is None
        if keeps_length and not (self.whole or self.drop):
            below[:, _OPACITIES].zero_()  # opposite numbers pass as they are, so the log leaves them out
        q = p.dot.new_zeros(1) if evidence is None else evidence.reliability.double()
        ω = times(below, ((1 - q) / (τ - 1))[:, None]).clamp_(self.weight_min, self.weight_max)  # s (1 - q), Eq. 11
        self._report(p, below, ω, evidence is not None)
        if self.drop:
            return Weights(keep=(below == 0).double())
        remove = per_norm.mul_(h2).mul_(below).mul_(ω)  # ω (c + τ_c) ‖h‖ / ‖l‖, Eq. 7
        if not keeps_length:
            return Weights(remove=remove)
        u = times(below, ω)  # ‖ĝ_HR‖² / ‖g_HR‖² = 1 + u² - 2 u c, where c = below - τ_c
        keep = times(u, u).addcmul_(u, below, value=-2).add_(u, alpha=2 * τ).add_(1).clamp_min_(_CANCELLED).rsqrt_()
        return Weights(keep, remove.mul_(keep))

    def _together(self, of_groups: Float[Tensor, "N G"]) -> Float[Tensor, "N G"]:
        """The sum over the groups that are compared, in the place of each."""
        compared = [of_groups[:, CONFLICT_GROUPS.index(group)] for group in self.groups]
        return torch.stack(compared, 1).sum(1, keepdim=True).repeat(1, of_groups.shape[1])

    def _report(self, p: Products, below: Float[Tensor, "N G"], ω: Float[Tensor, "N G"], has_evidence: bool) -> None:
        """Log what was corrected. It is counted when a log is read."""
        groups = [group for group in self.groups if group in p.names]
        if not groups:
            self._log_once(
                logging.WARNING, "GCO has no effect: it compares %s, and both scales have a gradient of %s alone. "
                "Set strategies.gco.groups.", ", ".join(self.groups), ", ".join(p.names),
            )  # fmt: skip
            return
        keeps_length = self.keep_length and not (has_evidence or self.drop)
        if keeps_length and groups == ["opacities"]:
            self._log_once(
                logging.WARNING, "GCO has no effect: an opacity is one number, and what is opposite keeps its length without "
                "evidence. Set strategies.gco.keep_length=false, or add p2g.",
            )  # fmt: skip
        elif not (has_evidence or keeps_length or self.drop):
            self._log_once(
                logging.INFO, "GCO corrects without evidence: LR prevails in every conflict, which costs PSNR if most of the SR "
                "detail is right. Set strategies.gco.keep_length=true, or add p2g.",
            )  # fmt: skip

        @cache
        def counted() -> tuple[Sequence[Number], ...]:
            corrected = (below < 0).sum(0, dtype=ω.dtype)  # times a float, whole numbers would become float32
            kept = len(below) - corrected  # their ω is at its lower bound, too
            sums = corrected, ω.sum(0) - self.weight_min * kept, (ω <= self.weight_min).sum(0) - kept
            return (p.comparable, *map(deferred.elements, sums))

        def share(part: int, whole: int, of: Sequence[str] = groups) -> Number:
            at = [CONFLICT_GROUPS.index(group) for group in of]
            total = [deferred.defer(deferred.added, *(counted()[k][i] for i in at)) for k in (part, whole)]
            return deferred.defer(deferred.ratio, *total)

        compared, corrected, weight, at_lower_bound = range(4)
        self.log("corrected", partial(share, corrected, compared))
        self.log("mean_omega", partial(share, weight, corrected))
        for group in groups:
            self.log(f"corrected_{group}", partial(share, corrected, compared, [group]))
        if has_evidence and self.weight_min > 0:
            self.log(_AT_LOWER_BOUND, partial(share, at_lower_bound, corrected))

    def _log_once(self, level: int, message: str, *arguments: str) -> None:
        if not self.cache.get(message):
            self.cache[message] = True
            _log.log(level, message, *arguments)


def _turns_something(squares: Float[Tensor, "N G"]) -> Bool[Tensor, " N"]:
    """True where a gradient of the rotation is more than rounding noise, see `_ROTATION_NOISE`."""
    return squares[:, _QUATS] > _ROTATION_NOISE**2 * squares[:, _SCALES]
