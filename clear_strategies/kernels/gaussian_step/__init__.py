"""The per-Gaussian step of an iteration in compiled code, which never stores the gradients: the chain rule to the raw parameters,
the same three parts as `kernels.reconcile` (products, the strategy's weights, apply), and Adam.

It is specified by `merging.conductor.Conductor.merge`, `training.field.Activation.vjp`, `training.optim.Adam.step` and
`training.field.GaussianField.constrain`. `training.compiled_step` calls it; tests/training/test_compiled_step.py compares.

`cpp.CppGaussianStep` runs on the CPU and returns Python numbers. `warp.WarpGaussianStep` runs on CUDA and returns tensors
there, so the host does not wait.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Int
from torch import Tensor

from clear_strategies.core.conflicts import Products, Weights


class Attribute(NamedTuple):
    """A parameter with its Adam moments, [N, …] each, updated in place.

    Args:
        rate: learning rate over the bias of the first moment.
        hr: ĝ_HR, if a strategy has computed it; λ_HR times it is added to the gradient. plus: added by regularizers.
        keep: factor of the parameter's decay per step.
        limit: the parameter is clamped to ±limit.
    """

    p: Tensor
    m: Tensor
    v: Tensor
    rate: float
    hr: Tensor | None = None
    plus: Tensor | None = None
    keep: float = 1.0
    limit: float = float("inf")


@dataclass(frozen=True, slots=True, eq=False)
class StepSettings:
    """The settings of a step that all attributes share.

    Args:
        bias2: bias of Adam's second moment.
        skips: skip rows that would not change.
        width: numbers of an shN row that are stepped, at least those of the active bands.
        changing: the rates, `bias2` and `lambda_hr` on a device, which replace those here; `warp.written` makes it.
    """

    beta1: float
    beta2: float
    bias2: float
    eps: float
    lambda_hr: float
    skips: bool
    width: int
    changing: Tensor | None = None


@runtime_checkable
class GaussianStep(Protocol):
    """The gradients of one view's losses, and the passes over them. Constructors are as of `cpp.CppGaussianStep`."""

    def products(self) -> Products:
        """The inner products of g_LR and g^HR."""
        ...

    def step(
        self, attributes: Mapping[str, Attribute], weights: Weights, settings: StepSettings
    ) -> int | Int[Tensor, ""]:  # fmt: skip
        """Merge, and apply Adam in place; returns the number of rows that were skipped because they would not change."""
        ...
