"""Work on CUDA that is recorded and replayed, one recording for each `ReplayKey`; see `rasterizers.recording`.

Work of a new kind runs live first, which compiles kernels and fills caches. The second time it is recorded, and from then on it
is replayed, as long as the tensors that it reads stay at their addresses. When they move, it is recorded again. If a recording or
a replay fails, all later work runs live.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Generic, TypeVar

import torch
from torch import Tensor

from rasterizers.interface import Camera
from rasterizers.recording import Recording, on_side_stream
from rasterizers.torch_internals import copy_each

_log = logging.getLogger(__name__)

_FAILED: Final = "a recording failed"
_MOST_MOVES: Final = 20  # changes of addresses without a replay between them; no structure changes so often
_MOST_RECORDINGS: Final = 8  # a recording keeps the memory of its work
_MOST_GUARD_FAILURES: Final = 8  # that replays have not paid for
_PAYS_AFTER: Final = 2  # replays

T = TypeVar("T")

Given = Sequence[Tensor | Camera | None]
"""The inputs of work that differ between replays, in a fixed order."""


@dataclass(frozen=True, slots=True)
class ReplayKey:
    """What Python decides by in the work: work with equal keys launches the same kernels.

    Args:
        rows: the number of Gaussians.
        addresses: of the tensors that the work reads in place. When they or `rows` change, every recording is dropped.
        shapes: see `shapes_of`. constants: whatever else Python looks at.
    """

    rows: int
    addresses: tuple[int, ...]
    shapes: tuple[Any, ...]
    constants: tuple[Any, ...]


def can_record(device: torch.device) -> bool:
    """Return True if work on the device can be recorded."""
    return device.type == "cuda"


def shapes_of(inputs: Given, rows: int) -> tuple[Any, ...]:
    """The shape of each input, with "rows" for that number, which says how many there are; and the size of each camera."""

    def shape(x: Tensor | Camera | None) -> Any:
        if isinstance(x, Tensor):
            return tuple("rows" if length == rows else length for length in x.shape)
        return x if x is None else (x.width, x.height)

    return tuple(map(shape, inputs))


class StaticInputs:
    """Copies of the inputs of recorded work, which stay at their addresses, so that a replay reads what was written to them.

    Args:
        numbers_of: the numbers of a camera on the device, see `rasterizers.interface.Recordable`.

    Attributes:
        copies: of the inputs, for the work that is recorded.
    """

    def __init__(self, inputs: Given, numbers_of: Callable[[Camera], Sequence[Tensor]] = lambda _: ()) -> None:
        self._numbers_of = numbers_of
        self.copies: list[Any] = [_copy(x) for x in inputs]
        self._tensors = self._tensors_of(self.copies)

    def write(self, inputs: Given) -> None:
        """Copy other inputs of the same shapes to `copies`."""
        write(self._tensors, self._tensors_of(inputs))

    def _tensors_of(self, inputs: Given) -> list[Tensor | None]:
        tensors: list[Tensor | None] = []
        for x in inputs:
            tensors += self._numbers_of(x) if isinstance(x, Camera) else (x,)
        return tensors


def _copy(x: Tensor | Camera | None) -> Tensor | Camera | None:
    if isinstance(x, Camera):
        return replace(x)  # numbers belong to a camera object
    return None if x is None else x.clone(memory_format=torch.contiguous_format)


class Replay(Generic[T]):
    """A recording with the inputs that it reads.

    Args:
        recording: of the work. inputs: those that it reads.
    """

    def __init__(self, recording: Recording[Any], inputs: StaticInputs) -> None:
        self._recording, self._inputs = recording, inputs

    def holds_at(self, t: int) -> bool:
        """Return True if Python decides at t as it did in the recording, e.g. in a strategy that compares the iteration."""
        return self._recording.holds_at(t)

    def replay(self, inputs: Given) -> bool:
        """Do the work with these inputs; False if the recording does not hold for them, before anything has changed."""
        self._inputs.write(inputs)
        return self._recording.replay()

    def outcome(self) -> T:
        """The result of the last replay."""
        raise NotImplementedError


class Replays:
    """The recordings of one training, or of the drawings of one thread.

    Args:
        name: of what ends when a recording fails, for the log.
        count: called with the reason whenever work runs live.
    """

    def __init__(self, device: torch.device, name: str, count: Callable[[str], None] = lambda reason: None) -> None:
        self._device, self._name, self._count = device, name, count
        self._replays: dict[ReplayKey, Any] = {}  # None: to be recorded
        self._warm = set[tuple[Any, ...]]()  # keys, apart from rows and addresses, of work that has run live
        self._structure: tuple[int, tuple[int, ...]] = (-1, ())  # the rows and addresses of a key
        self._moves = 0  # changes of them since the last replay
        self._guard_failures = 0.0  # less what the replays since then have saved
        self._failed = False

    def do(self, key: ReplayKey, t: int, inputs: Given, *, live: Callable[[], T], record: Callable[[], Replay[T]]) -> T:
        """Do the work live, while it is recorded, or by a replay."""
        if self._failed:
            return self._live(live, _FAILED)
        if (structure := (key.rows, key.addresses)) != self._structure:  # it has changed, and no recording holds
            self._replays.clear()
            self._structure, self._moves = structure, self._moves + 1
            if self._moves == _MOST_MOVES:
                _log.warning(
                    "%s: nothing is replayed, so that on a GPU an iteration takes two to three times as long. In each one, the "
                    "number of Gaussians is another one, or a tensor of the field or of a strategy's state is a new one. Write "
                    "to Strategy.state in place, by copy_().",
                    self._name,
                )
        if key not in self._replays:
            if len(self._replays) == _MOST_RECORDINGS:
                return self._live(live, f"more than {_MOST_RECORDINGS} kinds")
            self._replays[key] = None
            elsewhere = len(key.addresses), key.shapes, key.constants
            if elsewhere not in self._warm or self._moves > 1:  # a recording does not pay if addresses change each time
                self._warm.add(elsewhere)
                with on_side_stream(self._device):  # some caches belong to a stream
                    return self._live(live, "the first of its kind")
        try:
            replay = self._replays[key]
            if replay is not None and not replay.holds_at(t):
                replay, self._guard_failures = None, self._guard_failures + 1
                if self._guard_failures > _MOST_GUARD_FAILURES:
                    raise RuntimeError(
                        "a strategy decides by the iteration, or by what it stores in Python, and again and again another way. "
                        "Numbers that it changes belong in tensors that it writes in place."
                    )
            if replay is None:
                replay = record()
            elif replay.replay(inputs):
                self._moves, self._guard_failures = 0, max(0.0, self._guard_failures - 1 / _PAYS_AFTER)
            else:  # the next recording has space for more
                replay, reason = None, "the recorded lists of pairs are too short"
        except Exception as error:
            self._failed, replay, reason = True, None, _FAILED
            self._replays.clear()
            cause = f"{type(error).__name__}: {error}".partition("\n")[0]
            _log.warning("%s ends at t=%d, and iterations are live from now on: %s", self._name, t, cause)
        self._replays[key] = replay
        return self._live(live, reason) if replay is None else replay.outcome()

    def release(self) -> None:
        """Drop all recordings, with their memory on the device."""
        self._replays.clear()

    def _live(self, live: Callable[[], T], reason: str) -> T:
        self._count(reason)
        return live()


def write(static: Sequence[Tensor | None], inputs: Sequence[Tensor | None]) -> None:
    """Copy inputs to the static tensors that recorded work reads, by one kernel for all of one type and layout."""
    alike = defaultdict[torch.dtype, list[tuple[Tensor, Tensor]]](list)
    for x, y in zip(static, inputs, strict=True):
        if x is None or y is None:
            continue
        if x.dtype == y.dtype and x.stride() == y.stride():
            alike[x.dtype].append((x, y))
        else:
            x.copy_(y)
    for pairs in alike.values():
        copy_each(pairs)
