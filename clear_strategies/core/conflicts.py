"""Two gradients of a Gaussian, LR and HR: how they relate by attribute group, and the weights that reconcile them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """⟨l, h⟩, ‖l‖² and ‖h‖² of every Gaussian, in float64, where no product of two floats over- or underflows.

    Args:
        names: the groups that both gradients have.
        dot, l2, h2: a column for each of `CONFLICT_GROUPS`, 0 for a group that is not in `names`.
        comparable: how many Gaussians have two nonzero gradients, by group: invisible and dropped ones do not count (F38, F42);
            the seventh number is of whole Gaussians.
        opposed: how many of these have a cosine below 0.
    """

    names: Sequence[str]
    dot: Float[Tensor, "N G"]
    l2: Float[Tensor, "N G"]
    h2: Float[Tensor, "N G"]
    comparable: Sequence[Number]
    opposed: Sequence[Number]

    def conflict(self) -> dict[str, Number]:
        """The share of comparable Gaussians that are opposed, by group, and as "gaussian" for the groups together; NaN where
        nothing could be compared.
        """
        at = {name: k for k, name in enumerate(CONFLICT_GROUPS) if name in self.names} | {
            "gaussian": len(CONFLICT_GROUPS)
        }
        return {name: deferred.defer(deferred.ratio, self.opposed[k], self.comparable[k]) for name, k in at.items()}


class Weights(NamedTuple):
    """ĝ_HR = keep · g_HR - remove · g_LR, for each Gaussian and group.

    Args:
        keep, remove: a number, or a tensor on the device of the gradients, of any type: [N], one number for each Gaussian, or
            [N, G], one for each Gaussian and each of `CONFLICT_GROUPS`.
    """

    keep: float | Float[Tensor, " N"] | Float[Tensor, "N G"] = 1.0
    remove: float | Float[Tensor, " N"] | Float[Tensor, "N G"] = 0.0
