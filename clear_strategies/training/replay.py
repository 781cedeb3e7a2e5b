"""Iterations that are recorded and replayed: on a GPU, an iteration takes the host longer than the kernels.

What an iteration does with its view (render, losses, gradients, merge and step, statistics), and with an extra view, is
recorded once for each kind of iteration, see `rasterizers.replays`, and done again while the tensors of the field lie where they
lay. Before a replay, what the iteration is given is copied to where the recorded one read it: photo, SR image, what P2G looks
up, cameras, dropout mask, background, and the numbers of the optimizer's step. All else is live: what strategies and densifier
do after the step, and every iteration that cannot be replayed. A replay has the bits of the live iteration.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, cast

from torch import Tensor

from clear_strategies.core.view import Photo
from clear_strategies.kernels import losses
from clear_strategies.merging.replays import LIVE, RecordedWork, that_merge, why_strategies_are_not_recorded
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.given import Given, GivenExtra, GivenView, L, Learned
from clear_strategies.training.state import TrainState
from rasterizers.interface import Rasterizer, Recordable, over
from rasterizers.replays import Kind, Recorded, Replays, copied, write

_log = logging.getLogger(__name__)


def replays_for(s: TrainState, rasterizer: Rasterizer) -> IterationReplays | None:
    """The replays of this training; None, and a log line with the reason, where its iterations cannot be recorded. That is a
    warning where they were asked for.
    """
    reason = next(_why_not(s, rasterizer), None)
    if reason is None and s.compiled_step is not None and isinstance(rasterizer, Recordable):
        return IterationReplays(s, rasterizer, s.compiled_step)
    _log.log(logging.WARNING if s.settings.replay else logging.INFO, "Iterations are not replayed: %s.", reason)
    return None


def _why_not(s: TrainState, rasterizer: Rasterizer) -> Iterator[str]:
    if not isinstance(rasterizer, Recordable):
        yield f"{type(rasterizer).__name__} cannot be recorded; rasterizer=warp can"
    if s.compiled_step is None or not s.compiled_step.records:
        yield "the per-Gaussian step is not that of Warp"
    chosen = s.conductor.objective.kernels
    if (losses.running_on(s.device.type)[0] if chosen == "auto" else chosen) != "warp":
        yield "the losses are not those of Warp (objective.kernels)"
    yield from why_strategies_are_not_recorded(s.conductor)


class IterationReplays:
    """A `Replayer`: the recordings of one training."""

    def __init__(self, s: TrainState, rasterizer: Recordable, compiled_step: CompiledStep) -> None:
        self._state, self._rasterizer, self._count = s, rasterizer, compiled_step.count
        self._replays = Replays(s.device, "fit.replay", partial(s.conductor.work_log.skip, LIVE))

    def learn(self, given: Given, learn: Callable[..., L]) -> L:
        """See `given.Replayer`."""
        s, steps = self._state, self._state.optimizer.steps

        def live() -> L:
            s.optimizer.steps = steps  # a recording or a replay that failed has counted one
            return learn(s, self._rasterizer, given)

        def record() -> _Recorded:
            return _Recorded(s, self._rasterizer, given, self._count, learn)

        learned: L = self._replays.do(self._kind(given), given.t, given, live=live, record=record)
        return learned

    def _kind(self, given: Given) -> Kind:
        s, λ = self._state, self._state.conductor.objective.lambda_hr(given.t)
        tables = s.field.raw(), s.optimizer.first, s.optimizer.second, s.conductor.state_dict()
        statistics = [x for x in s.density.state_dict().values() if x.dim() > 0]  # others are made for a checkpoint
        stored = [s.field.filter_3d, *statistics, *(x for table in tables for x in table.values())]
        addresses = [x.data_ptr() for x in stored]
        facts: list[Any] = [s.field.degree, given.background is None, given.behind, λ > 0]
        if isinstance(given, GivenView):
            facts += [given.gate is None, *given.scales.values(), s.density.collects(given.t)]
            facts += [x is None for x in (given.view.depth, given.view.disagreement, given.view.truth)]
        else:
            facts.append(given.extra.robust)
        shapes = [(photo.image.shape, photo.shown is None, photo.transparency is None) for photo in given.photos]
        return Kind((len(s.field), *addresses), tuple(shapes), tuple(facts))


class _Recorded(Recorded[Given, Any]):
    """The recording of one kind of iteration, and the tensors from which it reads what it is given."""

    _work: RecordedWork

    def __init__(
        self, s: TrainState, rasterizer: Recordable, given: Given, count: Callable[[int], None], learn: Callable[..., Learned]
    ) -> None:  # fmt: skip
        self._count, self._device, self._look_up = count, s.device, s.conductor.looked_up
        self._rasterizer = rasterizer
        own, background = self._copied(given), copied(self._behind(given))
        drawn_by = rasterizer if background is None else rasterizer.over_changing(background)
        self._own = [*self._read_of(own), background]
        self._write(given)
        asked = that_merge(s.conductor) if isinstance(given, GivenView) else ()
        self._work = RecordedWork(s.device, s.conductor, lambda: learn(s, drawn_by, own), asked)

    def outcome(self, given: Given) -> Any:
        """See `Recorded`."""
        update, row = self._work.outcome()
        if isinstance(given, GivenView):
            # A strategy may store its tensors, which the next replay overwrites.
            update = replace(update, step=replace(update.step.copied(), t=given.t, view=given.view))
        return update, row

    def _copied(self, given: Given) -> Given:
        """The same with tensors and cameras of its own, and photos before the background of the iteration."""
        images = (p.over(given.background, given.behind).image.clone() for p in given.photos)
        photos = [
            Photo(replace(p.camera), image, copied(p.shown), p.transparency)
            for p, image in zip(given.photos, images, strict=True)
        ]
        if isinstance(given, GivenExtra):
            extra = replace(given.extra, photo=photos[0], weight=given.extra.weight.clone())
            return replace(given, extra=extra, background=None)
        lr, hr, *_ = [*photos, given.view.hr]  # where HR is not drawn, its size alone is read
        truth = hr.image if given.view.hr_is_photo else given.view.truth
        view = replace(given.view, lr=lr, hr=hr, truth=truth)
        looked_up = copied(self._look_up(given.view))
        return replace(given, view=view, gate=copied(given.gate), background=None, looked_up=looked_up)

    def _behind(self, given: Given) -> Tensor | None:
        """The background that an iteration has in place of the scene's."""
        if given.background is None:
            return None
        return cast(Recordable, over(self._rasterizer, given.background)).background_on(self._device)

    def _read_of(self, given: Given) -> list[Tensor | None]:
        """All other tensors that an iteration reads of what it is given."""
        read: list[Tensor | None] = []
        for photo in given.photos:
            image = photo.over(given.background, given.behind).image
            read += [image, photo.shown, *self._rasterizer.numbers_of(photo.camera, self._device)]
        if isinstance(given, GivenExtra):
            return [*read, given.extra.weight]
        looked_up = self._look_up(given.view) if given.looked_up is None else given.looked_up
        return [*read, given.gate, looked_up]

    def _write(self, given: Given) -> None:
        write(self._own, [*self._read_of(given), self._behind(given)])
        self._count(given.t)
