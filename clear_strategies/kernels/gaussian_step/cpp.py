"""The per-Gaussian pass: what goes in and what comes out, and how C++ does it. What the numbers mean is known to `fused.py`.

C++ counts in Python's numbers, and is done when it returns; Warp (`warp_step`) leaves its numbers on the device.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from jaxtyping import Float, Int
from torch import Tensor

from rasterizers.native import load_kernels, threads


@dataclass(frozen=True, slots=True)
class Comparison:
    """By conflict group, then for the Gaussian as a whole: how many could be compared, and how many point apart.

    Args:
        norm_lr, norm_hr: Σ ‖g_LR‖ and Σ ‖g_HR‖ over the comparable Gaussians, by group.
    """

    comparable: Sequence[int] | Int[Tensor, " 7"]
    opposed: Sequence[int] | Int[Tensor, " 7"]
    norm_lr: Sequence[float] | Float[Tensor, " 6"]
    norm_hr: Sequence[float] | Float[Tensor, " 6"]


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """GCO's settings as numbers, by conflict group where they differ. reliability: q [N], or None for 0."""

    groups: Sequence[bool]
    eps_cos: Sequence[float] | Float[Tensor, " 6"]
    eps_corr: Sequence[float] | Float[Tensor, " 6"]
    tolerance: float
    weight_min: float
    weight_max: float
    rotation_noise: float
    bounds_hold_omega: bool
    reliability: Tensor | None


@dataclass(frozen=True, slots=True, eq=False)
class Attribute:
    """A parameter with its moments, [N, …] each, updated in place.

    Args:
        anchor: θ^a, which pulls by `stiffness`. rate: over the bias of the first moment.
        keep: what decay leaves of the parameter. limit: it is projected to ±limit.
        merged: where its merged gradient is written instead of a step.
    """

    p: Tensor
    m: Tensor
    v: Tensor
    rate: float
    anchor: Tensor | None = None
    stiffness: float = 0.0
    keep: float = 1.0
    limit: float = float("inf")
    merged: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What all attributes share.

    Args:
        bias2: of Adam's second moment. visible: rows that may step, None: all. skips: leave out rows that would not move.
        width: numbers of an shN row that are stepped, those of the active bands at least.
    """

    beta1: float
    beta2: float
    bias2: float
    eps: float
    lambda_hr: float
    visible: Tensor | None
    skips: bool
    width: int


@dataclass(frozen=True, slots=True)
class Stepped:
    """By conflict group: rows corrected, Σ ω, rows with ω at its lower bound; and how many rows took no step, and why."""

    corrected: Sequence[int] | Int[Tensor, " 6"]
    omega: Sequence[float] | Float[Tensor, " 6"]
    at_lower_bound: Sequence[int] | Int[Tensor, " 6"]
    still: int | Int[Tensor, ""]
    invisible: int | Int[Tensor, ""]


class Sweeps(Protocol):
    """The two sweeps over one view's gradients."""

    def compare(self, products: Float[Tensor, "6 N"] | None = None) -> Comparison:
        """Conflicts before correction. products, float64: takes ‖g_LR‖‖g_HR‖ by group."""
        ...

    def step(self, attributes: Mapping[str, Attribute], correction: Correction | None, step: Step) -> Stepped:
        """Merge, correct, anchor and step, in place."""
        ...


class GaussianPass:
    """In C++: the gradients of one view's losses, as a rasterizer left them, and the two sweeps over them.

    Args:
        activation: scales, filtered [N, 3], filter, sigmoid, factor [N], and route: m [N] or None for 1.
        lr, base, hf: means, quats, scales, opacities, rgb and the basis Y [N, bases], each of one cotangent; base and hf
            may be None.

    Raises:
        BackendUnavailable: the kernels are not installed.
        TypeError, ValueError: a tensor is not float32, contiguous and in the CPU's memory, or has another shape.
    """

    def __init__(
        self,
        activation: Mapping[str, Tensor | None],
        lr: Mapping[str, Tensor],
        base: Mapping[str, Tensor] | None,
        hf: Mapping[str, Tensor] | None,
        lambda_hf: float,
    ) -> None:
        native: Any = load_kernels("clear_strategies.kernels")
        self._pass = native.GaussianPass(dict(activation), lr, base, hf, lr["basis"].shape[1], lambda_hf)

    def compare(self, products: Tensor | None = None) -> Comparison:
        return Comparison(*self._pass.compare({"products": products}, threads()))

    def step(self, attributes: Mapping[str, Attribute], correction: Correction | None, step: Step) -> Stepped:
        tables = {
            name: {slot: getattr(a, slot) for slot in Attribute.__slots__} | {"width": math.prod(a.p.shape[1:])}
            for name, a in attributes.items()
        }
        rule = None if correction is None else {slot: getattr(correction, slot) for slot in Correction.__slots__}
        settings = {slot: getattr(step, slot) for slot in Step.__slots__}
        return Stepped(*self._pass.step(tables, rule, settings, threads()))
