"""What the SR image of a view is worth: per patch, per Gaussian, and how a patch map reaches a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Bool, Float
from torch import Tensor


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
    """q_i and a_i of one view, in [0, 1]; both are 0 for a Gaussian that is not visible in the view (F24)."""

    reliability: Float[Tensor, " N"]
    demand: Float[Tensor, " N"]

    @cached_property
    def weight(self) -> Float[Tensor, " N"]:
        """w_i = q_i a_i."""
        return self.reliability * self.demand  # Eq. 10


def lift(
    patch_maps: Float[Tensor, "C ph pw"], centers: Float[Tensor, "N 2"], visible: Bool[Tensor, " N"], patch: float
) -> Float[Tensor, "C N"]:
    """Look up the patch p(u_i) that contains each projected centre, in several maps at once.  Eq. 10

    A centre outside the image has the border patch, an invisible Gaussian 0 (F24).

    Args:
        centers: u_i in pixels of the image that the patches tile; of invisible Gaussians anything, since gsplat leaves their
            rows uninitialised. patch: edge of a patch in those pixels.
    """
    column, row = (centers / patch).long().unbind(-1)  # of NaN or infinity any number, which the clamps bring inside
    height, width = patch_maps.shape[1:]
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    return patch_maps.flatten(1).index_select(1, row * width + column) * visible
