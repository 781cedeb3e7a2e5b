"""Evidence about the SR image of a view, its reliability and the demand for it: per patch, and per Gaussian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number


@dataclass(frozen=True, slots=True, eq=False)
class PatchMaps:
    """R_p and A_p of one view, in [0, 1].  Eq. 9

    Args:
        reliability: agreement of the SR image with the LR photo. demand: share of detail that it adds.
        patch: edge of a patch, LR pixels.
    """

    reliability: Float[Tensor, "ph pw"]
    demand: Float[Tensor, "ph pw"]
    patch: int


@dataclass(frozen=True, eq=False)
class Evidence:
    """q_i and a_i of one view, in [0, 1]; both are 0 for a Gaussian that is not visible in the view (F24).

    Args:
        sums: the number of visible Gaussians, Σ q_i and Σ w_i, on a device; None: not computed.
    """

    reliability: Float[Tensor, " N"]
    demand: Float[Tensor, " N"]
    sums: Float[Tensor, " 3"] | None = None

    @cached_property
    def weight(self) -> Float[Tensor, " N"]:
        """w_i = q_i a_i."""
        return self.reliability * self.demand  # Eq. 10

    def means(self, visible: Bool[Tensor, " N"]) -> Sequence[Number]:
        """The means of q_i and w_i over the Gaussians that are visible; NaN where none is."""
        if self.sums is not None:
            seen, *totals = deferred.elements(self.sums)
            return [deferred.defer(deferred.ratio, total, seen) for total in totals]
        return [deferred.scalar(x.sum() / visible.sum()) for x in (self.reliability, self.weight)]
