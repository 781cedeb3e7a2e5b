"""The contract of a densifier, which clones, splits, prunes and resets Gaussians while training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.gradients import Shot
from clear_strategies.merging.iteration import Update
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam


@runtime_checkable
class Gaussians(Protocol):
    """Raw parameters, whose rows a densifier gathers and whose values it changes in place: a `GaussianField`, or those of
    another trainer, which have nothing else.
    """

    @property
    def means(self) -> Float[Tensor, "N 3"]: ...

    @property
    def quats(self) -> Float[Tensor, "N 4"]: ...

    @property
    def scales(self) -> Float[Tensor, "N 3"]: ...

    @property
    def opacities(self) -> Float[Tensor, " N"]: ...

    def __len__(self) -> int: ...

    def raw(self) -> Mapping[str, Tensor]: ...

    def take(self, parents: Int[Tensor, " M"], fresh: Bool[Tensor, " M"]) -> None:
        """Row i becomes a copy of row parents[i]."""
        ...


@runtime_checkable
class Moments(Protocol):
    """What an optimizer keeps per Gaussian."""

    def take(self, parents: Int[Tensor, " M"], fresh: Bool[Tensor, " M"]) -> None:
        """Gather it, after the Gaussians; fresh rows start without momentum."""
        ...


@runtime_checkable
class Densifier(Protocol):
    """Changes the structure of the field while it trains."""

    @property
    def name(self) -> str:
        """Its name in the printed plan."""
        ...

    @property
    def settings(self) -> Any:
        """A dataclass; its milestones are printed."""
        ...

    @property
    def cap(self) -> int | None:
        """The most Gaussians that it lets the field have; None: any number."""
        ...

    @property
    def marks(self) -> Mapping[str, int]:
        """The iterations worth a mark on a curve."""
        ...

    def accumulate(self, update: Update, shot: Shot, t: int) -> None:
        """Accumulate the scores of iteration t; `shot` is the rendering that they belong to."""
        ...

    def step(self, field: GaussianField, optimizer: Adam, t: int, resized: Callable[[Int[Tensor, " M"]], None]) -> bool:
        """Do what is due at t, after the optimizer's step; returns whether the structure changed.

        Args:
            resized: called with parents[M] once field and optimizer have been gathered; row i of everything else per
                Gaussian now comes from row parents[i].
        """
        ...

    def reset_due(self, t: int) -> bool:
        """Whether opacities are lowered at t; renders right after that do not show how good the field is."""
        ...

    def state_dict(self) -> dict[str, Tensor]: ...

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None: ...


@runtime_checkable
class DensifierSettings(Protocol):
    """Settings of a densifier: a frozen dataclass that makes the densifier once the scene is known."""

    def densifier(
        self, n: int, *, extent: float, seed: int, white_background: bool, device: torch.device | str = "cpu"
    ) -> Densifier:
        """For a field of n Gaussians on `device`; `extent` is 3DGS's cameras_extent, world units."""
        ...


def cameras_extent(centers: Float[Tensor, "V 3"]) -> float:
    """3DGS's scene size: 1.1 times the largest distance of a training camera from their mean; a little where that is 0."""
    radius = torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()
    return 1.1 * float(radius) or 1e-6
