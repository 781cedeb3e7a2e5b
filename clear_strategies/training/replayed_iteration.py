"""Iterations that are recorded and replayed: on a GPU, an iteration takes the host longer than the kernels.

What an iteration does with its view (render, losses, gradients, merge and step, statistics), and with an extra view, is
recorded once for each kind of iteration, see `rasterizers.replays`, and done again while the tensors of the field lie where they
lay. Before a replay, what the iteration is given is copied to where the recorded one read it: photo, SR image, what P2G looks
up, cameras, dropout mask, background, and the numbers of the optimizer's step. All else is live: what strategies and densifier
do after the step, and every iteration that cannot be replayed. A replay has the bits of the live iteration.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.kernels import losses
from clear_strategies.merging.iteration import Update
from clear_strategies.merging.recorded_work import RecordedWork, replays_on, that_merge, why_strategies_are_not_recorded
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.state import TrainState
from rasterizers.interface import Color, Rasterizer, Recordable, can_be_recorded, over
from rasterizers.replays import Kind, Replays, copied, write

_log = logging.getLogger(__name__)

L = TypeVar("L", bound=tuple[Update | None, dict[str, Number]])
"""What an iteration has decided, None of an extra view, and columns of the history."""


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


@dataclass(frozen=True, slots=True, eq=False)
class GivenExtra:
    """What an iteration is given besides: an extra view.

    Args:
        t, background: as of `GivenView`.
    """

    t: int
    view: ExtraView
    background: Color | None

    @property
    def photos(self) -> Sequence[Photo]:
        """As of `GivenView`."""
        return [self.view.photo]


Given = GivenView | GivenExtra


def replays_for(s: TrainState, rasterizer: Rasterizer) -> Replays | None:
    """The replays of this training; None, and a log line with the reason, where its iterations cannot be recorded. That is a
    warning where they were asked for.
    """
    reason = next(_why_not(s, rasterizer), None)
    if reason is None:
        return replays_on(s.device, s.conductor.work_log, "fit.replay")
    _log.log(logging.WARNING if s.settings.replay else logging.INFO, "Iterations are not replayed: %s.", reason)
    return None


def learned(
    s: TrainState, rasterizer: Rasterizer, given: Given, learn: Callable[[TrainState, Rasterizer, Any], L]
) -> L:
    """What `learn` returns for the iteration, or a replay of it where `replays_for` has found that it can be one."""
    if s.replays is None:
        return learn(s, rasterizer, given)
    steps = s.optimizer.steps

    def live() -> L:
        s.optimizer.steps = steps  # a recording or a replay that failed has counted one
        return learn(s, rasterizer, given)

    def record() -> RecordedWork[Given, L]:
        return _recorded(s, cast(Recordable, rasterizer), given, learn)

    return s.replays.do(_kind(s, given), given.t, given, live=live, record=record)


def _why_not(s: TrainState, rasterizer: Rasterizer) -> Iterator[str]:
    if not can_be_recorded(rasterizer):
        yield f"{type(rasterizer).__name__} cannot be recorded; rasterizer=warp can"
    if s.compiled_step is None or not s.compiled_step.records:
        yield "the per-Gaussian step is not that of Warp"
    chosen = s.conductor.objective.kernels
    if (losses.running_on(s.device.type)[0] if chosen == "auto" else chosen) != "warp":
        yield "the losses are not those of Warp (objective.kernels)"
    yield from why_strategies_are_not_recorded(s.conductor)


def _kind(s: TrainState, given: Given) -> Kind:
    λ = s.conductor.objective.lambda_hr(given.t)
    tables = s.field.raw(), s.optimizer.first, s.optimizer.second, s.conductor.state_dict()
    statistics = [x for x in s.density.state_dict().values() if x.dim() > 0]  # others are made for a checkpoint
    stored = [s.field.filter_3d, *statistics, *(x for table in tables for x in table.values())]
    addresses = [x.data_ptr() for x in stored]
    facts: list[Any] = [s.field.degree, given.view.background, λ > 0]
    if isinstance(given, GivenView):
        facts += [given.gate is None, *given.scales.values(), s.density.collects(given.t)]
        facts += [x is None for x in (given.view.depth, given.view.disagreement, given.view.truth)]
    else:
        facts.append(given.view.robust)
    shapes = [(photo.image.shape, photo.shown is None, photo.transparency is None) for photo in given.photos]
    return Kind((len(s.field), *addresses), tuple(shapes), tuple(facts))


def _recorded(
    s: TrainState, rasterizer: Recordable, given: Given, learn: Callable[[TrainState, Rasterizer, Any], L]
) -> RecordedWork[Given, L]:
    """The recording of one kind of iteration, which reads what it is given from tensors of its own."""
    own, background = _copied(s, given), _behind(s, rasterizer, given).clone()
    drawn_by = rasterizer.over_changing(background)
    tensors = [*_tensors_of(s, rasterizer, own), background]
    step = cast(CompiledStep, s.compiled_step)

    def write_own(new: Given) -> None:
        write(tensors, [*_tensors_of(s, rasterizer, new), _behind(s, rasterizer, new)])
        step.count(new.t)

    def outcome(new: Given, update: Update | None, row: dict[str, Number]) -> Any:
        if isinstance(new, GivenView) and update is not None:
            # A strategy may store its tensors, which the next replay overwrites.
            update = replace(update, step=replace(update.step.copied(), t=new.t, view=new.view))
        return update, row

    write_own(given)
    asked = that_merge(s.conductor) if isinstance(given, GivenView) else ()
    return RecordedWork(
        s.device, s.conductor, lambda: learn(s, drawn_by, own), write=write_own, outcome=outcome, asked=asked
    )


def _copied(s: TrainState, given: Given) -> Given:
    """The same with tensors and cameras of its own, and photos before the background of the iteration."""
    images = (p.over(given.background, given.view.background).image.clone() for p in given.photos)
    photos = [
        Photo(replace(p.camera), image, copied(p.shown), p.transparency)
        for p, image in zip(given.photos, images, strict=True)
    ]
    if isinstance(given, GivenExtra):
        extra = replace(given.view, photo=photos[0], weight=given.view.weight.clone())
        return replace(given, view=extra, background=None)
    lr, hr, *_ = [*photos, given.view.hr]  # where HR is not drawn, its size alone is read
    truth = hr.image if given.view.hr_is_photo else given.view.truth
    view = replace(given.view, lr=lr, hr=hr, truth=truth)
    looked_up = copied(s.conductor.looked_up(given.view))
    return replace(given, view=view, gate=copied(given.gate), background=None, looked_up=looked_up)


def _behind(s: TrainState, rasterizer: Recordable, given: Given) -> Tensor:
    """The background of the iteration, or the scene's own."""
    return cast(Recordable, over(rasterizer, given.background)).background_on(s.device)


def _tensors_of(s: TrainState, rasterizer: Recordable, given: Given) -> list[Tensor | None]:
    """All other tensors that an iteration reads of what it is given."""
    tensors: list[Tensor | None] = []
    for photo in given.photos:
        image = photo.over(given.background, given.view.background).image
        tensors += [image, photo.shown, *rasterizer.numbers_of(photo.camera, s.device)]
    if isinstance(given, GivenExtra):
        return [*tensors, given.view.weight]
    looked_up = s.conductor.looked_up(given.view) if given.looked_up is None else given.looked_up
    return [*tensors, given.gate, looked_up]
