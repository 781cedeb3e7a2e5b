"""The per-Gaussian step of one iteration in compiled code: its inputs and its outputs.

It computes what the readable path computes, which specifies it: `merging.conductor.Conductor.merge`,
`strategies.gco.GCO.correct`, `strategies.svs.SVS.regularize`, `training.field.Activation.vjp`, `training.optim.Adam.step` and
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

from clear_strategies.core.compiled_rules import CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts


class Attribute(NamedTuple):
    """A parameter with its Adam moments, [N, …] each, updated in place.

    Args:
        rate: learning rate over the bias of the first moment.
        anchor: θ^a; adds (θ - θ^a) · `stiffness` to the gradient.
        keep: factor of the parameter's decay per step.
        limit: the parameter is clamped to ±limit.
        merged: receives the merged gradient; no step is taken then.
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
class StepSettings:
    """The settings of a step that all attributes share.

    Args:
        bias2: bias of Adam's second moment.
        skips: skip rows that would not change.
        width: numbers of an shN row that are stepped, at least those of the active bands.
        changing: on a device, the rates, `bias2` and `lambda_hr`, in place of the others: `warp.written` makes it.
    """

    beta1: float
    beta2: float
    bias2: float
    eps: float
    lambda_hr: float
    skips: bool
    width: int
    changing: Tensor | None = None


class StepCounts(NamedTuple):
    """What a step did.

    Args:
        conflicts: before and by the correction. still: rows that were skipped because they would not change.
    """

    conflicts: ConflictCounts
    still: int | Int[Tensor, ""]


@runtime_checkable
class GaussianStep(Protocol):
    """The pass over one view's gradients. Implementations take them as `cpp.CppGaussianStep` does."""

    def step(
        self, attributes: Mapping[str, Attribute], rule: CorrectionRule | None, q: Tensor | None, settings: StepSettings
    ) -> StepCounts:
        """Count conflicts, merge, correct, add the anchor's gradient and apply Adam, in place.

        Args:
            rule: None: nothing is corrected. q: reliability [N], None: 0.
        """
        ...
