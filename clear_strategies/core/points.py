"""A coloured point cloud."""

from __future__ import annotations

from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor


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
        """The points with these indices."""
        return replace(self, means=self.means[index], colors=self.colors[index])
