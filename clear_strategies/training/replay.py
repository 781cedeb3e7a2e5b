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
from rasterizers.recording import Recording, on_side_stream
from rasterizers.warp_runtime import sent

_log = logging.getLogger(__name__)

LIVE: Final = "live in place of a replay"
"""The work log's entry for iterations and extra views that were not replayed. It has no runs, so that none seem saved."""

_FAILED: Final = "a recording failed"
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
    """The recordings of one training. The work log counts the iterations that were live, by the reason, under `LIVE`."""

    def __init__(self, s: TrainState, rasterizer: Recordable, compiled_step: CompiledStep) -> None:
        self._state, self._rasterizer, self._count = s, rasterizer, compiled_step.count
        self._recorded: dict[_Kind, _Recorded | None] = {}  # None: seen once
        self._addresses: tuple[int, ...] = ()
        self._failed = False

    def learn(self, given: Given, learn: Callable[..., L]) -> L | None:
        """See `given.Replayer`.

        An iteration of a new kind is live first, so that kernels are compiled and caches filled, and is recorded the next time.
        Whatever fails in a recording or a replay, it is live, and so are all that follow.
        """
        if self._failed:
            self._note_live(_FAILED)
            return None
        kind = self._kind(given)
        if kind.addresses != self._addresses:  # the structure has changed, and with it everything that was recorded
            self._recorded.clear()
            self._addresses = kind.addresses
        if kind not in self._recorded:
            if len(self._recorded) == _MOST_KINDS:
                self._note_live(f"more than {_MOST_KINDS} kinds of iterations")
                return None
            self._recorded[kind] = None
            self._note_live("the first of its kind")
            with on_side_stream(self._state.device):  # some caches are of a stream
                return learn(self._state, self._rasterizer, given)
        optimizer, steps = self._state.optimizer, self._state.optimizer.steps
        try:
            recorded = self._recorded[kind] = self._done(self._recorded[kind], given, learn)
            reason = "the recorded lists of pairs are too short"  # recorded anew, with space for more
        except Exception as error:
            self._failed, recorded, reason = True, None, _FAILED
            self._recorded.clear()
            cause = f"{type(error).__name__}: {error}".partition("\n")[0]
            _log.warning("fit.replay ends at t=%d, and iterations are live from now on: %s", given.t, cause)
        if recorded is not None:
            return cast(L, recorded.learned(given))
        optimizer.steps = steps
        self._note_live(reason)
        return None

    def _done(self, recorded: _Recorded | None, given: Given, learn: Callable[..., L]) -> _Recorded | None:
        """What has done the iteration; None where the recording does not hold for it, before anything has changed."""
        if recorded is None:
            return _Recorded(self._state, self._rasterizer, given, self._count, learn)
        return recorded if recorded.replay(given) else None

    def _note_live(self, reason: str) -> None:
        self._state.conductor.work_log.skip(LIVE, reason)

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

    def __init__(
        self, s: TrainState, rasterizer: Recordable, given: Given, count: Callable[[int], None], learn: Callable[..., Learned]
    ) -> None:  # fmt: skip
        self._count, self._state, self._device, owner = count, s, s.device, s.conductor.owner("observe")
        self._look_up = None if owner is None else owner.looked_up
        self._numbers_of = rasterizer.numbers_of
        own, self._background = self._copied(given), s.field.means.new_empty(1, 3)
        drawn_by = rasterizer if given.background is None else rasterizer.over_changing(self._background)
        self._written = self._read_of(own)

        def work() -> tuple[Learned, Tensor, Callable[[Tensor], dict[str, Number]]]:
            learned = learn(s, drawn_by, own)
            counts = {f"skip {k}": count for k, (*_, count) in enumerate(self._skips) if isinstance(count, Tensor)}
            return learned, *deferred.gathered(learned.row | counts)

        self._write(given)
        with s.conductor.work_log.noted() as self._skips:
            self._recording = Recording(s.device, work)

    def replay(self, given: Given) -> bool:
        """Do the iteration; False where the recording does not hold for it, before anything has changed."""
        self._write(given)
        with self._state.conductor.work_log.stage("replayed"):
            return self._recording.replay()

    def learned(self, given: Given) -> Learned:
        """What the iteration made, with the numbers of its history copied: the next one overwrites them."""
        learned, numbers, row_of = self._recording.result
        row, skip = row_of(numbers.clone()), self._state.conductor.work_log.skip
        for k, (name, reason, count) in enumerate(self._skips):
            counted = row.pop(f"skip {k}", None)
            skip(name, reason, counted.vector[counted.k].long() if isinstance(counted, deferred.Element) else count)
        if isinstance(given, GivenExtra):
            return Learned(row)
        update = cast(LearnedView, learned).update
        return LearnedView(row, replace(update, step=replace(update.step, t=given.t, view=given.view)))

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


def _clone(x: Tensor | None) -> Tensor | None:
    return None if x is None else x.clone()
