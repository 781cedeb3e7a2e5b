"""A scene as training takes it: views at two scales, the points it starts from, and where each came from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Initial points: positions in world units, colours in [0, 1].

    Args:
        source: one phrase for the printed plan: which points, how many images made them.
        saw_test_views: whether test views had a part in them ("no", "yes", "unknown").
    """

    means: Float[Tensor, "N 3"]
    colors: Float[Tensor, "N 3"]
    source: str
    saw_test_views: str = "no"

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything a run needs to know about its input.

    Args:
        background: the colour behind the Gaussians, RGB in [0, 1].
        synthetic_prior: the references were made from the truth (the demo); reports say so.
        notes: label -> fact, in the order they are printed in the plan and saved as provenance.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    cloud: PointCloud
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    synthetic_prior: bool = False
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def device(self) -> torch.device:
        """Where the training views' images lie, and whatever is trained on them."""
        return self.train[0].lr.image.device

    def to(self, device: torch.device | str) -> Scene:
        """The same with all views on `device`; the cloud stays, for it is looked at once, on the CPU."""
        return replace(self, train=tuple(v.to(device) for v in self.train), test=tuple(v.to(device) for v in self.test))
