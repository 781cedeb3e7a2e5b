"""The per-Gaussian step in C++ (`kernels/src/step.cpp`), for tensors on the CPU."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.gradients import CONFLICT_GROUPS
from clear_strategies.kernels import native
from clear_strategies.kernels.gaussian_step import Attribute, StepSettings
from clear_strategies.kernels.reconcile.tables import addresses, weight_tables
from rasterizers.native import empty, threads


class CppGaussianStep:
    """The gradients of one view's losses, as the rasterizer returns them, and the pass over them.

    Args:
        activation: scales, filtered [N, 3], filter, sigmoid, factor [N], and the basis Y [N, bases].
        lr, hr: means, quats, scales, opacities and rgb of ∇L_LR and of g^HR, which has "detail", too, where f_det learns; hr may
            be None.

    Raises:
        BackendUnavailable: the kernels were not compiled.
        TypeError, ValueError: a tensor is not float32, contiguous and on the CPU, or has a wrong shape.
    """

    def __init__(
        self, activation: Mapping[str, Tensor], lr: Mapping[str, Tensor], hr: Mapping[str, Tensor] | None
    ) -> None:
        kernels: Any = native.module()
        self._n, bases = activation["basis"].shape
        self._passes = kernels.GaussianStep(dict(activation), dict(lr), None if hr is None else dict(hr), bases)

    def products(self) -> Products:
        table = empty((3, len(CONFLICT_GROUPS), self._n), torch.float64)
        return Products(CONFLICT_GROUPS, *(x.T for x in table), *self._passes.products(table.data_ptr(), threads()))

    def step(self, attributes: Mapping[str, Attribute], weights: Weights, settings: StepSettings) -> int:
        tables = {name: a._asdict() | {"width": math.prod(a.p.shape[1:])} for name, a in attributes.items()}
        numbers = {slot: getattr(settings, slot) for slot in StepSettings.__slots__ if slot != "changing"}
        rows = weight_tables(weights, self._n, torch.device("cpu"))
        still: int = self._passes.step(tables, addresses(rows), numbers, threads())
        return still
