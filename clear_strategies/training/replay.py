"""Iterations that are recorded and replayed: on a GPU, an iteration takes the host longer than the kernels.

What an iteration does with its view (render, losses, gradients, merge and step, statistics), and with an extra view, is
recorded once for each kind of iteration (`_Kind`), see `rasterizers.recording`, and done again while the tensors of the field
lie where they lay. Before a replay, what the iteration is given is copied to where the recorded one read it: photo, SR image,
what P2G looks up, cameras, dropout mask, background, and the numbers of the optimizer's step. All else is live: what strategies
and densifier do after the step, and every iteration that cannot be replayed. A replay has the bits of the live iteration.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final, cast

import torch
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.core.view import Photo, View
from clear_strategies.kernels import losses
from clear_strategies.strategies.base import describes, overrides
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.given import Given, GivenExtra, GivenView, L, Learned, LearnedView
from clear_strategies.training.state import TrainState
from rasterizers.interface import Rasterizer, Recordable
from rasterizers.recording import Recording
from rasterizers.warp_runtime import sent

_log = logging.getLogger(__name__)

_MOST_KINDS: Final = 8  # a recording keeps the memory of an iteration


def replays_for(s: TrainState, rasterizer: Rasterizer) -> Replays | None:
    """The replays of this training; None, and a log line with the reason, where its iterations cannot be recorded."""
    reason = next(_why_not(s, rasterizer), None)
    if reason is None and s.compiled_step is not None and isinstance(rasterizer, Recordable):
        return Replays(s, rasterizer, s.compiled_step)
    _log.warning("fit.replay has no effect: %s.", reason)
    return None


def _why_not(s: TrainState, rasterizer: Rasterizer) -> Iterator[str]:
    if not isinstance(rasterizer, Recordable):
        yield f"{type(rasterizer).__name__} cannot be recorded; rasterizer=warp can"
    if s.compiled_step is None or not s.compiled_step.records:
        yield "the per-Gaussian step is not that of Warp"
    chosen = s.conductor.objective.kernels
    if (losses.running_on(s.device.type)[0] if chosen == "auto" else chosen) != "warp":
        yield "the losses are not those of Warp (objective.kernels)"
    for strategy in s.conductor.strategies:
        if any(overrides(strategy, hook) for hook in ("observe", "route", "score")) and not describes(
            strategy, "looked_up"
        ):
            yield f"{type(strategy).__name__} does not state what it looks up of a view"


@dataclass(frozen=True, slots=True)
class _Kind:
    """What Python decides by in an iteration: iterations of one kind launch the same kernels.

    Args:
        addresses: where the tensors lie that it reads and steps.
    """

    addresses: tuple[int, ...]
    shapes: tuple[Any, ...]
    facts: tuple[Any, ...]


class Replays:
    """The recordings of one training."""

    def __init__(self, s: TrainState, rasterizer: Recordable, compiled_step: CompiledStep) -> None:
        self._state, self._rasterizer, self._count = s, rasterizer, compiled_step.count
        self._recorded: dict[_Kind, _Recorded | None] = {}  # None: seen once
        self._addresses: tuple[int, ...] = ()
        self._device, self._failed = s.device, False

    def learn(self, given: Given, learn: Callable[..., L]) -> L | None:
        """See `given.Replayer`.

        An iteration of a new kind is live first, so that kernels are compiled and caches filled, and is recorded the next time.
        """
        kind = self._kind(given)
        if kind.addresses != self._addresses:  # the structure has changed, and with it everything that was recorded
            self._recorded.clear()
            self._addresses = kind.addresses
        if kind not in self._recorded:
            if len(self._recorded) < _MOST_KINDS:
                self._recorded[kind] = None
            return None
        optimizer, recorded = self._state.optimizer, self._recorded[kind]
        steps = optimizer.steps
        learned: L | None = None
        if recorded is not None:
            learned = recorded.replay(given)
        elif not self._failed:
            recorded = _Recorded(self._state, self._rasterizer, given, self._count)
            learned = self._record(recorded, given, learn)
        # Lists that were too short are recorded anew, with space for more pairs.
        self._recorded[kind] = None if learned is None else recorded
        if learned is None:
            optimizer.steps = steps
        return learned

    def _record(self, recorded: _Recorded, given: Given, learn: Callable[..., L]) -> L | None:
        try:
            return recorded.record(given, learn)
        except RuntimeError as error:
            if self._device.type == "cpu":  # what is recorded there has been done
                raise
            self._failed = True
            _log.warning("fit.replay: an iteration could not be recorded, so that all are live from now on: %s", error)
            return None

    def _kind(self, given: Given) -> _Kind:
        s, λ = self._state, self._state.conductor.objective.lambda_hr(given.t)
        tables = s.field.raw(), s.optimizer.first, s.optimizer.second, s.density.state_dict(), s.conductor.state_dict()
        rows = [x for table in tables for x in table.values() if x.dim() > 0]  # others are no memory of the field's
        addresses = [x.data_ptr() for x in (s.field.filter_3d, *rows)]
        facts: list[Any] = [s.field.degree, given.background is None, given.behind, λ > 0]
        if isinstance(given, GivenView):
            facts += [given.gate is None, *given.scales.values(), s.density.collects(given.t)]
        else:
            facts.append(given.extra.robust)
        shapes = [(photo.image.shape, photo.shown is None) for photo in given.photos]
        return _Kind((len(s.field), *addresses), tuple(shapes), tuple(facts))


class _Recorded:
    """The recording of one kind of iteration, and the tensors from which it reads what it is given."""

    def __init__(self, s: TrainState, rasterizer: Recordable, given: Given, count: Callable[[int], None]) -> None:
        self._count, self._state, self._device, owner = count, s, s.device, s.conductor.owner("observe")
        self._look_up = None if owner is None else owner.looked_up
        self._numbers_of = rasterizer.numbers_of
        self._own, self._background = self._copied(given), s.field.means.new_empty(1, 3)
        self._rasterizer = rasterizer if given.background is None else rasterizer.over_changing(self._background)
        self._written = self._read_of(self._own)

    def record(self, given: Given, learn: Callable[..., L]) -> L:
        def work() -> tuple[L, Tensor, Callable[[Tensor], dict[str, Number]]]:
            learned = learn(self._state, self._rasterizer, self._own)
            counts = {f"skip {k}": count for k, (*_, count) in enumerate(skips) if isinstance(count, Tensor)}
            return learned, *deferred.gathered(learned.row | counts)

        self._write(given)
        with self._state.conductor.work_log.noted() as skips:
            self._recording: Recording[Any] = Recording(self._device, work)
        self._skips = skips
        return cast(L, self._learned(given))

    def replay(self, given: Given) -> Any | None:
        """What the iteration learns; None where the recording does not hold for it, before anything has changed."""
        self._write(given)
        with self._state.conductor.work_log.stage("replayed"):
            done = self._recording.replay()
        return self._learned(given) if done else None

    def _copied(self, given: Given) -> Given:
        """The same with tensors and cameras of its own, and photos that no background shows through."""
        copies = (p.over(given.background, given.behind) for p in given.photos)
        photos = [Photo(replace(p.camera), p.image.clone(), _clone(p.shown)) for p in copies]
        if isinstance(given, GivenExtra):
            extra = replace(given.extra, photo=photos[0], weight=given.extra.weight.clone())
            return replace(given, extra=extra, background=None)
        looked_up = None if self._look_up is None else _clone(self._look_up(given.view))
        lr, hr, *_ = [*photos, given.view.hr]  # where HR is not drawn, its size alone is read
        view = View(given.view.name, lr, hr, background=given.behind, looked_up=looked_up)
        return replace(given, view=view, gate=_clone(given.gate), background=None)

    def _read_of(self, given: Given) -> list[Tensor | None]:
        """All tensors that an iteration reads of what it is given."""
        read: list[Tensor | None] = []
        for photo in given.photos:
            image = photo.over(given.background, given.behind).image
            read += [image, photo.shown, *self._numbers_of(photo.camera, self._device)]
        if isinstance(given, GivenExtra):
            return [*read, given.extra.weight]
        return [*read, given.gate, None if self._look_up is None else self._look_up(given.view)]

    def _write(self, given: Given) -> None:
        """Write what the iteration is given to where the recorded one reads it."""
        for x, own in zip(self._read_of(given), self._written, strict=True):
            if x is not None and own is not None:
                own.copy_(x)
        if given.background is not None:
            self._background.copy_(sent(torch.tensor([given.background], dtype=torch.float32), self._device))
        self._count(given.t)

    def _learned(self, given: Given) -> Learned:
        """What the last replay made, with the numbers of its history copied: the next one overwrites them."""
        learned, numbers, row_of = self._recording.result
        row, skip = row_of(numbers.clone()), self._state.conductor.work_log.skip
        for k, (name, reason, count) in enumerate(self._skips):
            counted = row.pop(f"skip {k}", None)
            skip(name, reason, counted.vector[counted.k].long() if isinstance(counted, deferred.Element) else count)
        if deferred.is_immediate(numbers):
            deferred.resolve([row])
        if isinstance(given, GivenExtra):
            return Learned(row)
        step = replace(learned.update.step, t=given.t, view=given.view)
        return LearnedView(row, replace(learned.update, step=step))


def _clone(x: Tensor | None) -> Tensor | None:
    return None if x is None else x.clone()
