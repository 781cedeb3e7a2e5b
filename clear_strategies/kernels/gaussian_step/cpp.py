"""The per-Gaussian step in C++ (`kernels/src/step.cpp`), for tensors on the CPU."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from clear_strategies.core.compiled_rules import CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.kernels import native
from clear_strategies.kernels.gaussian_step import Attribute, StepCounts, StepSettings
from clear_strategies.kernels.merge.cpp import correction_table
from rasterizers.native import threads


class CppGaussianStep:
    """The gradients of one view's losses, as the rasterizer returns them, and the pass over them.

    Args:
        activation: scales, filtered [N, 3], filter, sigmoid, factor [N], and route: m [N], None: 1.
        lr, base, hf: means, quats, scales, opacities, rgb and the basis Y [N, bases], for one cotangent each; base and hf
            may be None.

    Raises:
        BackendUnavailable: the kernels were not compiled.
        TypeError, ValueError: a tensor is not float32, contiguous and on the CPU, or has a wrong shape.
    """

    def __init__(
        self,
        activation: Mapping[str, Tensor | None],
        lr: Mapping[str, Tensor],
        base: Mapping[str, Tensor] | None,
        hf: Mapping[str, Tensor] | None,
        lambda_hf: float,
    ) -> None:
        kernels: Any = native.module()
        self._step = kernels.GaussianStep(dict(activation), lr, base, hf, lr["basis"].shape[1], lambda_hf)

    def step(
        self, attributes: Mapping[str, Attribute], rule: CorrectionRule | None, q: Tensor | None, settings: StepSettings
    ) -> StepCounts:
        tables = {name: a._asdict() | {"width": math.prod(a.p.shape[1:])} for name, a in attributes.items()}
        numbers = {slot: getattr(settings, slot) for slot in StepSettings.__slots__ if slot != "changing"}
        conflicts, still = self._step.step(tables, correction_table(rule, q), numbers, threads())
        return StepCounts(ConflictCounts(*conflicts), still)
