"""GCO: Gaussian-wise conflict-aware optimization.  Eq. 6, 7, 11

An HR gradient that conflicts with the authentic LR gradient is corrected until the cosine of the two
reaches the margin, for each Gaussian and each attribute group. LR gradients are never changed.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.checks import refuse, require_choice, require_number
from clear_strategies.core.compiled_rules import ROTATION_NOISE, CorrectionRule, GroupReport
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads, row_dot, row_norm, scale_rows
from clear_strategies.core.step import Step
from clear_strategies.strategies.base import Strategy

_log = logging.getLogger(__name__)

# ω at its lower bound in this share of the corrections means that the prior agrees with LR and GCO does nothing.
_INACTIVE_SHARE: Final = 0.9
_AT_LOWER_BOUND: Final = "omega_at_lower_bound"  # the column of that share
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

    def in_hindsight(self, means: Mapping[str, float]) -> str | None:
        share = means.get(_AT_LOWER_BOUND, 0.0)
        if share <= _INACTIVE_SHARE:
            return None
        return (
            f"GCO was inactive: omega sat at its lower bound {self.weight_min:g} in {share:.0%} of the corrections, because the "
            "prior agrees with the LR images (reliability near 1)."
        )

    def correction_rule(self) -> CorrectionRule:
        return CorrectionRule(self.groups, self.tolerance, self.weight_min, self.weight_max, self.report)

    def correct(self, lr: Mapping[str, Tensor], hr: Mapping[str, Tensor], step: Step | None = None) -> Grads:
        """g̃_HR for every group; logs what was corrected.

        Args:
            lr, hr: attribute -> gradient [N, …], any of `CONFLICT_GROUPS`; what only one of them has is not compared.
            step: gives the reliability of Eq. 11; None: nothing is known of it, and conflicts are corrected in full.

        Raises:
            ValueError: both have gradients, but none of the same group, so that nothing could be corrected.
        """
        evidence = None if step is None else step.evidence
        corrected, reports = Grads(hr), []
        for group in self.groups:
            if group in lr and group in hr:
                corrected[group], report = self._correct_group(group, lr, hr, evidence)
                reports.append(report)
        if lr and hr and not reports:
            raise ValueError(
                f"GCO compares the groups {', '.join(self.groups)}, and no two gradients are of one: lr has "
                f"{', '.join(lr)}, hr has {', '.join(hr)}. Name them so."
            )
        self.report(reports, evidence)
        return corrected

    def _correct_group(
        self, group: str, lr: Mapping[str, Tensor], hr: Mapping[str, Tensor], evidence: Evidence | None
    ) -> tuple[Tensor, GroupReport]:
        g_lr, g_hr = lr[group], hr[group]
        dot, n_lr, n_hr = row_dot(g_lr, g_hr), row_norm(g_lr), row_norm(g_hr)
        comparable = (n_lr > 0) & (n_hr > 0)
        n = n_lr * n_hr
        c = torch.where(n > 0, dot / n.clamp_min(_TINY), 0.0)  # Eq. 6
        conflict = c < -self.tolerance
        if group == "quats":
            conflict &= ~(_turns_nothing(lr) | _turns_nothing(hr))

        # Only the rows in conflict change; every other row keeps its bits. On the CPU these rows are gathered. On a device
        # gathering would wait for their number, so all rows are corrected and the others restored.
        i = conflict.nonzero()[:, 0] if deferred.is_immediate(conflict) else slice(None)
        conflicting = conflict[i]
        q = evidence.reliability[i].double() if evidence is not None else 0.0
        s = ((-c[i] - self.tolerance) / (1 - self.tolerance)).clamp(0, 1)
        omega = (s * (1 - q)).clamp(self.weight_min, self.weight_max)  # Eq. 11
        d = dot[i] + self.tolerance * n[i]
        multiple = omega * (d / n_lr[i].square())
        corrected = g_hr.clone()
        moved = (g_hr[i].double() - scale_rows(g_lr[i].double(), multiple)).to(g_hr.dtype)  # Eq. 7
        corrected[i] = torch.where(conflicting.view(-1, *[1] * (moved.dim() - 1)), moved, corrected[i])
        at_bound = conflicting & (omega <= self.weight_min)
        compared, touched, bound = (deferred.scalar(rows.sum()) for rows in (comparable, conflict, at_bound))
        return corrected, GroupReport(group, compared, touched, deferred.total(omega, conflicting), bound)

    def report(self, reports: Sequence[GroupReport], evidence: Evidence | None) -> None:
        compared, corrected, omega, at_bound = (
            deferred.defer(deferred.added, *(getattr(c, name) for c in reports))
            for name in ("compared", "corrected", "omega", "at_lower_bound")
        )
        self.log("corrected", deferred.defer(deferred.ratio, corrected, compared))
        self.log("mean_omega", deferred.defer(deferred.ratio, omega, corrected))
        for c in reports:
            self.log(f"corrected_{c.group}", deferred.defer(deferred.ratio, c.corrected, c.compared))
        if corrected != 0 and evidence is not None and self.weight_min > 0:
            self.log(_AT_LOWER_BOUND, deferred.defer(deferred.ratio, at_bound, corrected))


def _turns_nothing(g: Mapping[str, Tensor]) -> Bool[Tensor, " N"]:
    """Whether a gradient of the rotation is rounding noise, see `ROTATION_NOISE`."""
    if "scales" not in g:
        return torch.zeros_like(g["quats"][:, 0], dtype=torch.bool)
    return row_norm(g["quats"]) <= ROTATION_NOISE * row_norm(g["scales"])
