"""What an iteration is given, what it learns from its view, and who may learn in its place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.view import View
from clear_strategies.merging.iteration import Update
from rasterizers.interface import Color


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """What an iteration is given.

    Args:
        t: the iteration. view: as the skips leave it. scales: whether "lr" and "hr" are drawn.
        gate: zᵗ. background: behind everything that is drawn; None: the scene's own.
    """

    t: int
    view: View
    scales: Mapping[str, bool]
    gate: Tensor | None
    background: Color | None


class Learned(NamedTuple):
    """What an iteration made of its view: the update, and columns of the history."""

    update: Update
    row: dict[str, Number]


@runtime_checkable
class Replayer(Protocol):
    """Does what a recorded iteration did, see `training.replay.Replays`."""

    def learn(self, given: Given, learn: Callable[..., Learned]) -> Learned | None:
        """What the iteration learns; None where `learn` has to be called."""
        ...
