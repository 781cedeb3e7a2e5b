"""A strategy's arithmetic as data, in the form that the compiled per-Gaussian step takes."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number, Scalar
from clear_strategies.core.evidence import Evidence

# A Gaussian whose axes are equally long does not change when it is rotated: in exact arithmetic its
# rotation gradient is 0, in floating point it is noise that would "conflict" one time in five.
ROTATION_NOISE: Final = 2.0**-18


@dataclass(frozen=True, slots=True, eq=False)
class GroupReport:
    """What a correction did to one attribute group.

    Args:
        compared, corrected: Gaussians. omega: the sum of ω over the corrected ones.
        at_lower_bound: how many of these have ω at its lower bound.
        margin: the median of ‖g_LR‖‖g_HR‖ over an absolute ε; None where ε is relative.
    """

    group: str
    compared: Number
    corrected: Number
    omega: Number
    at_lower_bound: Number
    margin: Number | None


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionRule:
    """A correction of conflicting gradients by attribute group.  Eq. 6, 7, 11

    Args:
        groups: the attributes that are compared and corrected.
        tolerance: τ_c. weight_min, weight_max: bounds of ω, or of the coefficient ω|d|/‖g_LR‖².
        bounds_omega: whether the bounds hold ω (else the coefficient).
        epsilons: (mean ‖g_LR‖, mean ‖g_HR‖) of a group -> ε of the cosine and of the correction.
        absolute_eps: the cosine's ε where it is one number for all groups; None: it is relative.
        report: called with one `GroupReport` per group, and the evidence, after every step.
    """

    groups: Sequence[str]
    tolerance: float
    weight_min: float
    weight_max: float
    bounds_omega: bool
    epsilons: Callable[[Scalar, Scalar], tuple[Scalar, Scalar]]
    absolute_eps: float | None
    report: Callable[[Sequence[GroupReport], Evidence | None], None]


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A pull of every parameter towards a fixed value: gradient = stiffness · (θ - target).  Eq. 16

    Args:
        targets, stiffness: by attribute; an absent attribute is free.
    """

    targets: Mapping[str, Tensor]
    stiffness: Mapping[str, float]


def margin(product: Float[Tensor, " N"], eps: float) -> Number:
    """The median of ‖g_LR‖‖g_HR‖ over an absolute ε > 0; NaN where nothing is compared."""
    return deferred.defer(operator.truediv, deferred.median(product, product > 0), eps)
