"""GCO: Gaussian-wise conflict-aware optimization.  Eq. 6, 7, 11

An HR gradient that conflicts with the authentic LR gradient is corrected until the cosine of the two
reaches the margin, for each Gaussian and each attribute group. LR gradients are never changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.checks import refuse, require_choice, require_number
from clear_strategies.core.compiled_rules import ROTATION_NOISE, CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts, GradientColumns, counted
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.core.step import Step
from clear_strategies.kernels import merge
from clear_strategies.strategies.base import Strategy

# The column of the share of corrections with ω at its lower bound: near 1, the prior agrees with LR.
_AT_LOWER_BOUND: Final = "omega_at_lower_bound"
_SCALES: Final = CONFLICT_GROUPS.index("scales")
_QUATS: Final = CONFLICT_GROUPS.index("quats")
_TINY: Final = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class GCO(Strategy):
    """Correct conflicting HR gradients.

    Args:
        tolerance: τ_c in [0, 1): cosines down to -τ_c are no conflict.
        weight_min, weight_max: bounds of ω where a conflict is corrected, 0 <= min <= max <= 1.
        groups: the attributes that are compared and corrected, each separately.

    There is no ε: norms and products are in float64, where those of float32 gradients do not vanish, and a zero norm is no
    conflict (F27). The opacity group has one dimension: its cosine is ±1, so every disagreement is a full conflict.
    Without evidence q = 0, and the LR gradient prevails (F32).

    Raises:
        SettingError: a setting is outside its range.
    """

    tolerance: float = 0.05
    weight_min: float = 0.05
    weight_max: float = 0.75
    groups: Sequence[str] = CONFLICT_GROUPS

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

    def correction_rule(self) -> CorrectionRule:
        return CorrectionRule(self.groups, self.tolerance, self.weight_min, self.weight_max, self.report)

    def correct(self, lr: Mapping[str, Tensor], hr: Mapping[str, Tensor], step: Step | None = None) -> Grads:
        """g̃_HR for every group; logs what was corrected. In one compiled pass where there is one for these tensors, with the same
        decisions as `correct_in_torch` except where a cosine lies within 2e-7 of its bound.

        Args:
            lr, hr: attribute -> gradient [N, …], any of `CONFLICT_GROUPS`; what only one of them has is not compared, and what
                is None is left out.
            step: gives the reliability of Eq. 11; None: nothing is known of it, and conflicts are corrected in full.

        Raises:
            ValueError: both have gradients, but none of the same group, so that nothing could be corrected.
        """
        lr, hr = ({name: g for name, g in grads.items() if g is not None} for grads in (lr, hr))
        q = None if step is None or step.evidence is None else step.evidence.reliability
        both = [group for group in self.groups if group in lr and group in hr]
        if not both or (compiled := merge.compiled(g[name] for name in both for g in (lr, hr))) is None:
            return self.correct_in_torch(lr, hr, step)
        rows = {
            name: merge.Rows(
                torch.empty_like(hr[name], memory_format=torch.contiguous_format), lr=lr[name], hr=hr[name]
            )
            for name in both
        }
        counts, _ = compiled(rows, self.correction_rule(), q, keeps_lr=False)
        self.report(counts, both, q is not None)
        return Grads(hr | {name: row.out for name, row in rows.items()})

    def correct_in_torch(self, lr: Mapping[str, Tensor], hr: Mapping[str, Tensor], step: Step | None = None) -> Grads:
        """The same as equations, on any device: the specification of every compiled pass."""
        if not lr or not hr:
            return Grads(hr)
        columns = GradientColumns.of(lr, hr, self.groups)
        p, τ = columns.products(), self.tolerance
        n = (p.l2 * p.h2).sqrt()
        c = torch.where(n > 0, p.dot / n.clamp_min(_TINY), 0.0)  # Eq. 6
        conflict = c < -τ
        conflict[:, _QUATS] &= _turns_something(p.l2) & _turns_something(p.h2)
        q = 0.0 if step is None or step.evidence is None else step.evidence.reliability.double()[:, None]
        s = ((-c - τ) / (1 - τ)).clamp(0, 1)
        ω = (s * (1 - q)).clamp(self.weight_min, self.weight_max)  # Eq. 11
        multiple = torch.where(conflict, ω * (p.dot + τ * n) / p.l2, 0.0)
        corrected = columns.minus(multiple, like=hr)  # Eq. 7
        counts = replace(
            counted(p), corrected=deferred.elements(conflict.sum(0)), omega=deferred.elements((ω * conflict).sum(0)),
            at_lower_bound=deferred.elements((conflict & (ω <= self.weight_min)).sum(0)),
        )  # fmt: skip
        self.report(counts, columns.names, isinstance(q, Tensor))
        return Grads({**hr, **corrected})

    def report(self, counts: ConflictCounts, groups: Sequence[str], has_evidence: bool) -> None:
        """Log what was corrected in these groups."""
        at = [CONFLICT_GROUPS.index(group) for group in groups if group in self.groups]
        compared, corrected, ω, at_bound = (
            deferred.defer(deferred.added, *(values[k] for k in at))
            for values in (counts.comparable, counts.corrected, counts.omega, counts.at_lower_bound)
        )
        self.log("corrected", deferred.defer(deferred.ratio, corrected, compared))
        self.log("mean_omega", deferred.defer(deferred.ratio, ω, corrected))
        for k in at:
            share = deferred.defer(deferred.ratio, counts.corrected[k], counts.comparable[k])
            self.log(f"corrected_{CONFLICT_GROUPS[k]}", share)
        if corrected != 0 and has_evidence and self.weight_min > 0:
            self.log(_AT_LOWER_BOUND, deferred.defer(deferred.ratio, at_bound, corrected))


def _turns_something(squares: Float[Tensor, "N G"]) -> Bool[Tensor, " N"]:
    """Whether a gradient of the rotation is more than rounding noise, see `ROTATION_NOISE`."""
    return squares[:, _QUATS] > ROTATION_NOISE**2 * squares[:, _SCALES]
