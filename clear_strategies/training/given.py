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
    """

    t: int
    view: View
    scales: Mapping[str, bool]
    gate: Tensor | None
    background: Color | None

    @property
    def photos(self) -> Sequence[Photo]:
        """The photos, before the background of the iteration."""
        return [photo.over(self.background, self.view.background) for photo in (self.view.lr, self.view.hr)]


@dataclass(frozen=True, slots=True, eq=False)
class GivenExtra:
    """What an iteration is given besides: an extra view.

    Args:
        gate: what `ExtraView.gate` answers. t, background: as of `GivenView`.
    """

    t: int
    extra: ExtraView
    gate: Tensor | None
    background: Color | None

    @property
    def photos(self) -> Sequence[Photo]:
        """As of `GivenView`."""
        return [self.extra.photo.over(self.background, self.extra.background)]


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What an iteration made of an extra view: columns of the history."""

    row: dict[str, Number]


@dataclass(frozen=True, slots=True, eq=False)
class LearnedView(Learned):
    """What an iteration made of its view."""

    update: Update


Given = GivenView | GivenExtra
L = TypeVar("L", bound=Learned)


@runtime_checkable
class Replayer(Protocol):
    """Does what a recorded iteration did, see `training.replay.Replays`."""

    def learn(self, given: Given, learn: Callable[..., L]) -> L | None:
        """What the iteration learns; None where `learn` has to be called."""
        ...
