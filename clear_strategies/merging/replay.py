"""Replays of work with strategies, on top of `rasterizers.replays`: logs, counts of skipped work, what is recordable."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

import torch
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.merging.conductor import Conductor
from clear_strategies.strategies.base import Strategy, overrides
from rasterizers.guards import Guarded
from rasterizers.interface import Camera
from rasterizers.recording import Recording
from rasterizers.replays import Given, Replay, Replays, StaticInputs, can_record

T = TypeVar("T")

LIVE: Final = "live in place of a replay"
"""The work log's entry for work that was not replayed. It counts reasons and no runs, so that no work seems to be saved."""


class LoggedReplay(Replay[tuple[T, dict[str, Number]]]):
    """A replay with counts of what the work skips, numbers for the history, and the logs of strategies.

    Its outcome is the result of the work, whose tensors the next replay overwrites, and a copy of the numbers.

    Args:
        work: is given copies of the inputs, and returns its result, and numbers by name. See `Recording`.
        inputs, numbers_of: see `StaticInputs`. t: the iteration.
        calls: the strategies that the work calls. The recording holds while they store what they stored before it.
        count: called with the iteration before the recording and before each replay; it writes to the device what depends on it.
    """

    def __init__(
        self, device: torch.device, conductor: Conductor, work: Callable[[Any], tuple[T, Mapping[str, Number]]], inputs: Given,
        t: int, *, numbers_of: Callable[[Camera], Sequence[Tensor]] = lambda _: (), calls: Iterable[Strategy] = (),
        count: Callable[[int], None] = lambda _: None,
    ) -> None:  # fmt: skip
        static, self._t, self._count = StaticInputs(inputs, numbers_of), t, count
        count(t)
        self._conductor, self._calls = conductor, [*calls]
        self._stored = [*map(_stored_by, self._calls)]  # before the work, which may change it
        self._of_t: dict[str, Any] = {}  # numbers that Python computes from the iteration

        def gathered() -> tuple[Any, Tensor, Callable[[Tensor], dict[str, Number]]]:
            made, numbers = work(static.copies)
            logged = [(s, name, x) for s in conductor.strategies for name, x in s.logs.items()]
            self._logged = [(s, name) for s, name, _ in logged]
            row = {**numbers, **{f"log {k}": x() if callable(x) else x for k, (*_, x) in enumerate(logged)}}
            self._of_t = {name: x for name, x in row.items() if isinstance(x, Guarded)}
            return made, *deferred.gathered({name: x for name, x in row.items() if name not in self._of_t})

        conductor.logs.keep()
        try:
            with conductor.work_log.noted() as self._skips:
                super().__init__(Recording(device, gathered), static)
        finally:
            for s in conductor.strategies:
                s.logs.clear()  # they hold tensors of the recording

    def holds_at(self, t: int) -> bool:
        self._t = t
        return self._stored == [*map(_stored_by, self._calls)] and super().holds_at(t)

    def replay(self, inputs: Given) -> bool:
        self._count(self._t)
        with self._conductor.work_log.stage("replayed"):
            return super().replay(inputs)

    def outcome(self) -> tuple[T, dict[str, Number]]:
        """The result of the last replay. The strategies' logs are those of the work afterwards."""
        made, numbers, row_of = self._recording.result
        row: dict[str, Number] = row_of(numbers.clone()) | {name: x.at(self._t) for name, x in self._of_t.items()}
        for skip in self._skips:
            self._conductor.work_log.skip(*skip)
        for k, (s, name) in enumerate(self._logged):
            s.logs[name] = row.pop(f"log {k}")
        return made, row


def merging_strategies(conductor: Conductor) -> Iterator[Strategy]:
    """The strategies that a merge calls."""
    return (s for s in conductor.strategies if any(overrides(s, h) for h in ("reconcile", "correct", "regularize")))


def _stored_by(strategy: Strategy) -> Any:
    """All that a strategy stores apart from what checkpoints save, in a form that `==` compares, and the CPU numbers among that,
    which a replay would repeat. A tensor that is written in place stays equal to itself.
    """
    numbers = [x for x in strategy.state.values() if x.dim() == 0] + [*strategy.run_state.values()]
    of_host = [x.tolist() for x in numbers if not can_record(x.device)]
    saved = ("state", "run_state", "logs")
    return of_host + [_comparable(x) for name, x in vars(strategy).items() if name not in saved]


def _comparable(x: Any) -> Any:
    if isinstance(x, dict):
        return [*x, *map(_comparable, x.values())]
    if isinstance(x, (list, tuple, set, deque)):
        return [*map(_comparable, x)]
    if type(x) in (bool, int, float, str):
        return x
    # x is kept alive, so that no other object gets its id.
    return id(x), x, _comparable(getattr(x, "__dict__", None) or ())


def logged_replays(device: torch.device, conductor: Conductor, name: str) -> Replays | None:
    """`Replays` whose live work the work log counts as `LIVE`; None if work on the device cannot be recorded."""
    if not can_record(device):
        return None
    return Replays(device, name, lambda reason: conductor.work_log.skip(LIVE, reason))


def why_not_recordable(conductor: Conductor) -> Iterator[str]:
    """A reason for each strategy that may depend on more of a view than `looked_up` returns. A class that overrides it speaks for
    its own hooks, and not for those that a subclass overrides.
    """
    for cls in map(type, conductor.strategies):
        stated_by: Any = next(base for base in cls.__mro__ if "looked_up" in vars(base))
        if any(getattr(cls, hook) is not getattr(stated_by, hook) for hook in ("observe", "route", "score")):
            yield f"{cls.__name__} does not state what it looks up of a view"
