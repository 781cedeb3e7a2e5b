"""What an iteration is given: its view, or an extra view; what it learns from it, and who may learn in its place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.merging.iteration import Update
from rasterizers.interface import Color


@dataclass(frozen=True, slots=True, eq=False)
class GivenView:
    """What an iteration is given.

    Args:
        t: the iteration. view: as the skips leave it. scales: whether "lr" and "hr" are drawn.
        gate: zᵗ. background: behind everything that is drawn; None: the scene's own.
        looked_up: see `Step.looked_up`; a recording has it.
    """

    t: int
    view: View
    scales: Mapping[str, bool]
    gate: Tensor | None
    background: Color | None
    looked_up: Tensor | None = None

    @property
    def photos(self) -> Sequence[Photo]:
        """The photos that the iteration compares renderings with: LR, and HR where it is drawn."""
        return [self.view.lr, self.view.hr] if self.scales["hr"] else [self.view.lr]

    @property
    def behind(self) -> Color:
        """The background of the photos."""
        return self.view.background


@dataclass(frozen=True, slots=True, eq=False)
class GivenExtra:
    """What an iteration is given besides: an extra view.

    Args:
        t, background: as of `GivenView`.
    """

    t: int
    extra: ExtraView
    background: Color | None

    @property
    def photos(self) -> Sequence[Photo]:
        """As of `GivenView`."""
        return [self.extra.photo]

    @property
    def behind(self) -> Color:
        """As of `GivenView`."""
        return self.extra.background


Given = GivenView | GivenExtra
Learned = tuple[Update | None, dict[str, Number]]
"""What the iteration decided, None of an extra view, and columns of the history."""
L = TypeVar("L", bound=Learned)


@runtime_checkable
class Replayer(Protocol):
    """Calls `learn`, or does again what a recorded iteration did, see `training.replay`."""

    def learn(self, given: Given, learn: Callable[..., L]) -> L:
        """What the iteration learns."""
        ...
