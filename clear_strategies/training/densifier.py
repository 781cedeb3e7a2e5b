"""The contract of a densifier, which clones, splits, prunes and resets Gaussians while training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.core.gradients import Shot
from clear_strategies.core.view import View
from clear_strategies.merging.iteration import Update
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam


class Densifier:
    """Changes the structure of the field while it trains.

    Attributes:
        name: its name in the plan of a run.
        settings: a dataclass, whose milestones the plan shows.
        cap: the most Gaussians that it lets the field have; None: any number.
    """

    name: str
    settings: Any
    cap: int | None = None

    @property
    def second_stage(self) -> int | None:
        """The iteration at which the second stage begins, for a method with two stages; None: it has one."""
        return None

    def collects(self, t: int) -> bool:
        """Return True if `accumulate` reads the scores of iteration t; else they are not computed."""
        return True

    def accumulate(self, update: Update, shot: Shot, t: int) -> None:
        """Accumulate the scores of iteration t, if `collects(t)`; `shot` is the rendering that they belong to.

        Args:
            update: without `grads`, which the compiled step does not store.
        """

    def step(self, field: GaussianField, optimizer: Adam, t: int, resized: Callable[[Int[Tensor, " M"]], None]) -> bool:
        """Do what is due at t, after the optimizer's step; returns whether the structure changed.

        Args:
            field: its rows change by `take(parents)`, its parameters in place, as `field.opacities.data`.
            optimizer: its rows change by `take(parents, fresh)`; fresh rows start without momentum.
            resized: called with parents[M] once field and optimizer have been gathered; row i of everything else per
                Gaussian now comes from row parents[i]. A densifier that moves a Gaussian onto another must gather, too, although
                their number stays, so that the state of strategies and optimizer follows the rows.
        """
        raise NotImplementedError

    def settled(self, t: int) -> bool:
        """Return True if the structure does not change after t."""
        return False

    def gather(self, parents: Int[Tensor, " M"]) -> None:
        """Gather its own tensors after a change of structure by others: row i comes from row parents[i]."""

    def reset_due(self, t: int) -> bool:
        """Return True if opacities are lowered at t. Renders right after that do not show the quality of the field."""
        return False

    def state_dict(self) -> dict[str, Tensor]:
        """The tensors for a checkpoint."""
        return {}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the tensors that `state_dict` returned."""


@runtime_checkable
class DensifierSettings(Protocol):
    """Settings of a densifier: a frozen dataclass that makes the densifier once the scene is known."""

    def densifier(self, field: GaussianField, views: Sequence[View], seed: int) -> Densifier:
        """See `Strategy.densifier`."""
        ...


def cameras_extent(views: Sequence[View]) -> float:
    """3DGS's scene size: 1.1 times the largest distance of a training camera from their mean; a little where that is 0."""
    centers = torch.stack([view.hr.camera.center.float() for view in views])
    radius = torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()
    return 1.1 * float(radius) or 1e-6
