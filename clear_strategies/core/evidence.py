"""What the SR image of a view is worth: per patch, per Gaussian, and how a patch map reaches a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

Lookup = Literal["nearest", "bilinear"]
Outside = Literal["clamp", "neutral"]


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


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """q_i and a_i of one view, in [0, 1]; both are 0 for a Gaussian that is not visible in the view (F24)."""

    reliability: Float[Tensor, " N"]
    demand: Float[Tensor, " N"]

    @property
    def weight(self) -> Float[Tensor, " N"]:
        """w_i = q_i a_i."""
        return self.reliability * self.demand  # Eq. 10


def lift(
    patch_maps: Float[Tensor, "C ph pw"],
    centers: Float[Tensor, "N 2"],
    visible: Bool[Tensor, " N"],
    patch: float,
    size: tuple[int, int],
    lookup: Lookup = "nearest",
    outside: Outside = "clamp",
) -> Float[Tensor, "C N"]:
    """Look up the patch p(u_i) that contains each projected centre, in several maps at once.  Eq. 10

    Args:
        centers: u_i in pixels of the image that the patches tile. patch: edge of a patch in those pixels.
        size: (width, height) of that image.
        lookup: "nearest" patch, or "bilinear" between patch centres.
        outside: the value of a visible Gaussian whose centre lies outside the image: that of the border
            patch ("clamp") or 0 ("neutral"). Invisible Gaussians are 0 in any case.
    """
    x, y = (centers / patch).unbind(-1)
    height, width = patch_maps.shape[1:]
    if lookup == "bilinear":
        grid = torch.stack((2 * x / width - 1, 2 * y / height - 1), dim=-1)[None, None]
        values = F.grid_sample(patch_maps[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
    else:
        column, row = x.clamp(0, width - 1).long(), y.clamp(0, height - 1).long()
        values = patch_maps.flatten(1).index_select(1, row * width + column)
    counted = visible
    if outside == "neutral":
        (x, y), (width, height) = centers.unbind(-1), size
        counted = counted & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return values * counted
