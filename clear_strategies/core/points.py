"""A coloured point cloud."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

MAX_POINTS: Final = 200_000
"""The most initial points by default, here and in other trainers."""


def spread(means: Float[Tensor, "N 3"]) -> float:
    """The size of a scene, world units: nine tenths of its points lie so close to their median."""
    distances = torch.linalg.vector_norm(means - means.median(dim=0).values, dim=-1)
    return float(distances.kthvalue(max(1, round(0.9 * len(distances)))).values)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points: positions in world units, colours in [0, 1].

    Args:
        source: one phrase for the printed plan: which points, from how many images.
        uses_test_views: whether test views were used for the points ("no", "yes", "unknown").
    """

    means: Float[Tensor, "N 3"]
    colors: Float[Tensor, "N 3"]
    source: str
    uses_test_views: str = "no"

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Int[Tensor, " K"]) -> PointCloud:
        return replace(self, means=self.means[index], colors=self.colors[index])

    def at_most(self, count: int, seed: int = 0) -> PointCloud:
        """The cloud itself, or `count` of its points, chosen at random by the seed and in their order."""
        if len(self) <= count:
            return self
        chosen = torch.randperm(len(self), generator=torch.Generator().manual_seed(seed))[:count]
        return self[chosen.sort().values]
