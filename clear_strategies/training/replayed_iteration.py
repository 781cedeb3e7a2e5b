"""Iterations that are recorded and replayed: on a GPU, launching an iteration takes longer than its kernels.

What an iteration does with its view (render, losses, gradients, merge and step, statistics) and with an extra view is recorded,
see `rasterizers.replays`, and replayed as long as the field's tensors stay at their addresses. Before a replay, the inputs are
copied to the static tensors that the recording reads: photo, SR image, what P2G looks up, cameras, dropout mask, background, the
numbers of the optimizer's step. Everything else is live: what strategies and densifier do after the step, and every iteration
that cannot be replayed. A replay has the bits of a live iteration.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import Any, TypeVar, cast

from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.step import Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.kernels import native
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.replay import LoggedReplay, logged_replays, merging_strategies, why_not_recordable
from clear_strategies.strategies.base import Strategy
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.state import TrainState
from rasterizers.interface import Color, Rasterizer, Recordable, is_recordable, over
from rasterizers.replays import Given, ReplayKey, Replays, shapes_of

_log = logging.getLogger(__name__)

L = TypeVar("L", bound=tuple[Step | None, dict[str, Number]])
"""The step as strategies see it, None for an extra view, and columns of the history."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewInputs:
    """The inputs of an iteration.

    Args:
        t: the iteration. view: with the SR image that `Conductor.skips` chooses. scales: whether "lr" and "hr" are drawn.
        gate: zᵗ. background: behind everything that is drawn; None: the scene's own.
        looked_up: see `Step.looked_up`; None outside of a recording.
    """

    t: int
    view: View
    scales: Mapping[str, bool]
    gate: Tensor | None
    background: Color | None
    looked_up: Tensor | None = None

    def given(self, conductor: Conductor) -> Given:
        """What a replay reads in place of this iteration's own, apart from the background."""
        photos = [self.view.lr, self.view.hr] if self.scales["hr"] else [self.view.lr]
        return self.gate, conductor.looked_up(self.view), *(x for photo in photos for x in _given(photo, self))

    def reading(self, given: Sequence[Any]) -> ViewInputs:
        """The same inputs with what is given in their place."""
        gate, looked_up, *photos = given
        lr = _reading(self.view.lr, photos[:3])
        hr = _reading(self.view.hr, photos[3:]) if photos[3:] else self.view.hr  # without HR, only its size is read
        return replace(self, view=replace(self.view, lr=lr, hr=hr), gate=gate, background=None, looked_up=looked_up)

    def constants(self, s: TrainState) -> Sequence[Any]:
        """What Python decides by, apart from the shapes of what is given."""
        v = self.view
        layers = v.depth, v.disagreement, v.truth, v.lr.transparency, v.hr.transparency if self.scales["hr"] else None
        return [*self.scales.values(), s.density.collects(self.t), *(x is None for x in layers)]

    def calls(self, conductor: Conductor) -> Iterable[Strategy]:
        """The strategies that a recording depends on by what they store."""
        return *merging_strategies(conductor), *conductor.comparing


@dataclass(frozen=True, slots=True, eq=False)
class ExtraViewInputs:
    """The inputs of an iteration's step on an extra view; methods as of `ViewInputs`.

    Args:
        t, background: see `ViewInputs`.
    """

    t: int
    view: ExtraView
    background: Color | None

    def given(self, conductor: Conductor) -> Given:
        return self.view.weight, *_given(self.view.photo, self)

    def reading(self, given: Sequence[Any]) -> ExtraViewInputs:
        weight, *photo = given
        view = replace(self.view, photo=_reading(self.view.photo, photo), weight=weight)
        return replace(self, view=view, background=None)

    def constants(self, s: TrainState) -> Sequence[Any]:
        return self.view.robust, self.view.photo.transparency is None

    def calls(self, conductor: Conductor) -> Iterable[Strategy]:
        return ()


Inputs = TypeVar("Inputs", ViewInputs, ExtraViewInputs)


def _given(photo: Photo, inputs: ViewInputs | ExtraViewInputs) -> Given:
    """The photo over the background of the iteration, in parts."""
    photo = photo.over(inputs.background, inputs.view.background)
    return photo.camera, photo.image, photo.shown


def _reading(photo: Photo, given: Sequence[Any]) -> Photo:
    """The photo that is given in place of this one."""
    camera, image, shown = given
    return Photo(camera, image, shown, photo.transparency)


def replays_for(s: TrainState, rasterizer: Rasterizer) -> Replays | None:
    """The replays of this training; None if its iterations cannot be recorded. A log line gives the reason: a warning if the
    settings ask for replays.
    """
    reason = next(_why_not_recordable(s, rasterizer), None)
    if reason is None:
        return logged_replays(s.device, s.conductor, "fit.replay")
    _log.log(logging.WARNING if s.settings.replay else logging.INFO, "Iterations are not replayed: %s.", reason)
    return None


def replayed(learn: Callable[[TrainState, Rasterizer, Inputs], L]) -> Callable[[TrainState, Rasterizer, Inputs], L]:
    """The function, recorded and replayed in a training that has `replays`. Its work may read no number from the device."""

    @wraps(learn)
    def learned(s: TrainState, rasterizer: Rasterizer, inputs: Inputs) -> L:
        if s.replays is None:
            return learn(s, rasterizer, inputs)
        steps, drawn_by = s.optimizer.steps, cast(Recordable, rasterizer)
        background = cast(Recordable, over(rasterizer, inputs.background)).background_on(s.device)
        given = background, *inputs.given(s.conductor)

        def live() -> tuple[Step | None, dict[str, Number]]:
            s.optimizer.steps = steps  # a failed recording or replay has counted one
            return learn(s, rasterizer, inputs)

        def recorded(copies: Sequence[Any]) -> L:
            background, *others = copies
            return learn(s, drawn_by.over_changing(background), inputs.reading(others))

        def record() -> LoggedReplay[Step | None]:
            return LoggedReplay(
                s.device, s.conductor, recorded, given, inputs.t, calls=inputs.calls(s.conductor),
                numbers_of=partial(drawn_by.numbers_of, device=s.device), count=cast(CompiledStep, s.compiled_step).count,
            )  # fmt: skip

        step, row = s.replays.do(_key(s, inputs, given), inputs.t, given, live=live, record=record)
        if step is not None:
            view: Any = inputs.view
            # A strategy may store tensors of the step, which the next replay overwrites.
            step = replace(step.copied(), t=inputs.t, view=view)
        return cast(L, (step, row))

    return learned


def _why_not_recordable(s: TrainState, rasterizer: Rasterizer) -> Iterator[str]:
    if not is_recordable(rasterizer):
        yield f"{type(rasterizer).__name__} cannot be recorded; rasterizer=warp can"
    if s.compiled_step is None or not s.compiled_step.recordable:
        yield "the per-Gaussian step is not that of Warp"
    chosen = s.conductor.objective.kernels
    if (native.fastest(s.device) if chosen == "auto" else chosen) != "warp":
        yield "the losses are not those of Warp (objective.kernels)"
    yield from why_not_recordable(s.conductor)


def _key(s: TrainState, inputs: ViewInputs | ExtraViewInputs, given: Given) -> ReplayKey:
    λ = s.conductor.objective.lambda_hr(inputs.t)
    tables = s.field.raw(), s.optimizer.first, s.optimizer.second, s.conductor.state_dict()
    statistics = [x for x in s.density.state_dict().values() if x.dim() > 0]  # numbers are made for a checkpoint
    stored = [s.field.filter_3d, *statistics, *(x for table in tables for x in table.values())]
    addresses = [x.data_ptr() for x in stored]
    bands = max(cast(CompiledStep, s.compiled_step).bands, (s.field.degree + 1) ** 2 - 1)  # that the step will change
    constants = s.field.degree, bands, inputs.view.background, λ > 0, *inputs.constants(s)
    return ReplayKey(n := len(s.field), tuple(addresses), shapes_of(given, n), constants)
