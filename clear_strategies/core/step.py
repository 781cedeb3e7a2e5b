"""One training iteration, as strategies see it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.deferred import Scalar
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import in_our_shapes
from clear_strategies.core.view import View


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One training iteration.

    Args:
        t: the iteration, from 1.
        view: the photo and the SR image of this iteration, each with its camera.
        visible: the Gaussians that the HR render shows, [N]; None in an iteration without HR.
        evidence: the answer of `Strategy.observe`; None before it, and where no strategy gives one.
        params: raw parameters by attribute (log scales, logit opacities [N]), to read; empty if the structure has changed since.
        looked_up: if the iteration is replayed, what `Strategy.looked_up` returned for the view; None: the strategy calls it.
    """

    t: int
    view: View
    visible: Bool[Tensor, " N"] | None = None
    evidence: Evidence | None = None
    params: Mapping[str, Tensor] = field(default_factory=dict)
    looked_up: Tensor | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", in_our_shapes(self.params))

    def copied(self) -> Step:
        """The same step with copies of its tensors."""
        e, visible = self.evidence, self.visible
        if e is not None:
            e = Evidence(e.reliability.clone(), e.demand.clone(), None if e.sums is None else e.sums.clone())
        return replace(self, visible=None if visible is None else visible.clone(), evidence=e)

    def resized(self, parents: Int[Tensor, " M"]) -> Step:
        """The same step after the structure changed: row i of everything per Gaussian comes from row parents[i]."""
        visible = None if self.visible is None else self.visible[parents]
        e = self.evidence
        evidence = None if e is None else Evidence(e.reliability[parents], e.demand[parents])
        return replace(self, visible=visible, evidence=evidence, params={})


class Losses(NamedTuple):
    """The losses of one image.

    Args:
        values: the losses by name, columns of the history.
        cotangents: their gradients with respect to the image: of L_LR; or of L_base, and of L_HF where λ_HF > 0.
    """

    values: Mapping[str, Scalar]
    cotangents: Float[Tensor, "K H W 3"]
