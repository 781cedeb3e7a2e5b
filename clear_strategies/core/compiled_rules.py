"""A strategy's arithmetic as data, in the form that the compiled per-Gaussian passes take."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from torch import Tensor

from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.core.gradients import CONFLICT_GROUPS

# A Gaussian whose axes are equally long does not change when it is rotated: in exact arithmetic its
# rotation gradient is 0, in floating point it is noise that would "conflict" one time in five.
ROTATION_NOISE: Final = 2.0**-18


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionRule:
    """A correction of conflicting gradients by attribute group.  Eq. 6, 7, 11

    Args:
        groups: the attributes that are compared and corrected.
        tolerance: τ_c. weight_min, weight_max: bounds of ω.
        report: called with what was counted, the groups that were compared, and whether there was evidence.
    """

    groups: Sequence[str]
    tolerance: float
    weight_min: float
    weight_max: float
    report: Callable[[ConflictCounts, Sequence[str], bool], None]

    @property
    def corrects(self) -> list[bool]:
        """Whether each of the conflict groups is corrected."""
        return [group in self.groups for group in CONFLICT_GROUPS]


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A pull of every parameter towards a fixed value: gradient = stiffness · (θ - target).  Eq. 16

    Args:
        targets, stiffness: by attribute; an absent attribute is free.
    """

    targets: Mapping[str, Tensor]
    stiffness: Mapping[str, float]
