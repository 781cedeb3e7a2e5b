"""Iterations that are recorded and replayed: on a GPU, launching an iteration takes longer than its kernels.

What an iteration does with its view (render, losses, gradients, merge and step, statistics) and with an extra view is recorded,
see `rasterizers.replays`, and replayed as long as the field's tensors stay at their addresses. Before a replay, the inputs are
copied to the static tensors that the recording reads: photo, SR image, what P2G looks up, cameras, dropout mask, background, the
numbers of the optimizer's step. Everything else is live: what strategies and densifier do after the step, and every iteration
that cannot be replayed. A replay has the bits of a live iteration.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import Any, TypeVar, cast

from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.kernels import native
from clear_strategies.merging.iteration import Update
from clear_strategies.merging.recorded_work import RecordedWork, merging_strategies, replays_on, why_not_recorded
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.state import TrainState
from rasterizers.interface import Color, Rasterizer, Recordable, can_be_recorded, over
from rasterizers.replays import Given, GraphKey, Replays, shapes_of

_log = logging.getLogger(__name__)

L = TypeVar("L", bound=tuple[Update | None, dict[str, Number]])
"""The update, None for an extra view, and columns of the history."""


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

    @property
    def photos(self) -> Sequence[Photo]:
        """The photos that the iteration compares renderings with: LR, and HR where it is drawn."""
        return [self.view.lr, self.view.hr] if self.scales["hr"] else [self.view.lr]


@dataclass(frozen=True, slots=True, eq=False)
class ExtraViewInputs:
    """The inputs of an iteration's step on an extra view.

    Args:
        t, background: see `ViewInputs`.
    """

    t: int
    view: ExtraView
    background: Color | None

    @property
    def photos(self) -> Sequence[Photo]:
        """See `ViewInputs`."""
        return [self.view.photo]


IterationInputs = ViewInputs | ExtraViewInputs
Inputs = TypeVar("Inputs", ViewInputs, ExtraViewInputs)


def replays_for(s: TrainState, rasterizer: Rasterizer) -> Replays | None:
    """The replays of this training; None if its iterations cannot be recorded. A log line gives the reason: a warning if the
    settings ask for replays.
    """
    reason = next(_why_not(s, rasterizer), None)
    if reason is None:
        return replays_on(s.device, s.conductor, "fit.replay")
    _log.log(logging.WARNING if s.settings.replay else logging.INFO, "Iterations are not replayed: %s.", reason)
    return None


def replayable(learn: Callable[[TrainState, Rasterizer, Inputs], L]) -> Callable[[TrainState, Rasterizer, Inputs], L]:
    """The function, recorded and replayed in a training that has `replays`. Its work may read no number from the device."""

    @wraps(learn)
    def learned(s: TrainState, rasterizer: Rasterizer, inputs: Inputs) -> L:
        if s.replays is None:
            return learn(s, rasterizer, inputs)
        return _replayed(s, s.replays, rasterizer, inputs, learn)

    return learned


def _replayed(
    s: TrainState, replays: Replays, rasterizer: Rasterizer, inputs: IterationInputs,
    learn: Callable[[TrainState, Rasterizer, Any], L],
) -> L:  # fmt: skip
    """The result of `learn`, run live, recorded, or replayed."""
    steps, given, drawn_by = s.optimizer.steps, _given(s, rasterizer, inputs), cast(Recordable, rasterizer)

    def live() -> tuple[Update | None, dict[str, Number]]:
        s.optimizer.steps = steps  # a failed recording or replay has counted one
        return learn(s, rasterizer, inputs)

    def recorded(copies: list[Any]) -> L:
        background, *rest = copies
        return learn(s, drawn_by.over_changing(background), _reading(inputs, rest))

    def record() -> RecordedWork[Update | None]:
        merging, comparing = merging_strategies(s.conductor), s.conductor.comparing
        return RecordedWork(
            s.device, s.conductor, recorded, given, inputs.t, numbers_of=partial(drawn_by.numbers_of, device=s.device),
            calls=(*merging, *comparing) if isinstance(inputs, ViewInputs) else (),
            count=cast(CompiledStep, s.compiled_step).count,
        )  # fmt: skip

    update, row = replays.do(_key(s, inputs, given), inputs.t, given, live=live, record=record)
    if isinstance(inputs, ViewInputs) and update is not None:
        # A strategy may store tensors of the step, which the next replay overwrites.
        update = replace(update, step=replace(update.step.copied(), t=inputs.t, view=inputs.view))
    return cast(L, (update, row))


def _why_not(s: TrainState, rasterizer: Rasterizer) -> Iterator[str]:
    if not can_be_recorded(rasterizer):
        yield f"{type(rasterizer).__name__} cannot be recorded; rasterizer=warp can"
    if s.compiled_step is None or not s.compiled_step.records:
        yield "the per-Gaussian step is not that of Warp"
    chosen = s.conductor.objective.kernels
    if (native.fastest(s.device) if chosen == "auto" else chosen) != "warp":
        yield "the losses are not those of Warp (objective.kernels)"
    yield from why_not_recorded(s.conductor)


def _key(s: TrainState, inputs: IterationInputs, given: Given) -> GraphKey:
    λ = s.conductor.objective.lambda_hr(inputs.t)
    tables = s.field.raw(), s.optimizer.first, s.optimizer.second, s.conductor.state_dict()
    statistics = [x for x in s.density.state_dict().values() if x.dim() > 0]  # numbers are made for a checkpoint
    stored = [s.field.filter_3d, *statistics, *(x for table in tables for x in table.values())]
    addresses = [x.data_ptr() for x in stored]
    bands = max(cast(CompiledStep, s.compiled_step).bands, (s.field.degree + 1) ** 2 - 1)  # that the step will change
    constants: list[Any] = [s.field.degree, bands, inputs.view.background, λ > 0]
    if isinstance(inputs, ViewInputs):
        constants += [*inputs.scales.values(), s.density.collects(inputs.t)]
        constants += [x is None for x in (inputs.view.depth, inputs.view.disagreement, inputs.view.truth)]
    else:
        constants.append(inputs.view.robust)
    constants += [photo.transparency is None for photo in inputs.photos]
    return GraphKey(n := len(s.field), tuple(addresses), shapes_of(given, n), tuple(constants))


def _given(s: TrainState, rasterizer: Rasterizer, inputs: IterationInputs) -> Given:
    """What a replay reads in place of an iteration's own: the background, the gate or an extra view's weight, what is looked up,
    and each photo over the background, with its camera.
    """
    background = cast(Recordable, over(rasterizer, inputs.background)).background_on(s.device)
    each = [p.over(inputs.background, inputs.view.background) for p in inputs.photos]
    photos = [x for p in each for x in (p.camera, p.image, p.shown)]
    if isinstance(inputs, ExtraViewInputs):
        return background, inputs.view.weight, None, *photos
    return background, inputs.gate, s.conductor.looked_up(inputs.view), *photos


def _reading(inputs: IterationInputs, given: list[Any]) -> IterationInputs:
    """The inputs of an iteration that reads these, except for the background."""
    gate, looked_up, *of_photos = given
    each = zip(inputs.photos, of_photos[::3], of_photos[1::3], of_photos[2::3], strict=True)
    photos = [Photo(camera, image, shown, p.transparency) for p, camera, image, shown in each]
    if isinstance(inputs, ExtraViewInputs):
        return replace(inputs, view=replace(inputs.view, photo=photos[0], weight=gate), background=None)
    lr, hr = photos[0], photos[1] if inputs.scales["hr"] else inputs.view.hr  # without HR, only its size is read
    return replace(inputs, view=replace(inputs.view, lr=lr, hr=hr), gate=gate, background=None, looked_up=looked_up)
