"""Work on CUDA that is recorded by its kind and replayed; see `rasterizers.recording`.

Work of a new kind is live first, so that kernels are compiled and caches filled. The next time it is recorded, and then it is
replayed while the tensors that it reads lie where they lay. Where they lie elsewhere, it is recorded anew. Whatever fails in a
recording or a replay, all that follows is live.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import torch
from torch import Tensor

from rasterizers.recording import Recording, on_side_stream

_log = logging.getLogger(__name__)

DEVICES: Final = {"cuda"}
"""The kinds of devices whose work can be recorded; tests add the CPU."""

_FAILED: Final = "a recording failed"
_RESTLESS: Final = 20  # changes of memory without a replay between them, where no structure changes so often
_MOST_KINDS: Final = 8  # a recording keeps the memory of its work
_MOST_TURNS: Final = 8  # recordings made anew that have not paid off
_PAYS_AFTER: Final = 2  # replays

G = TypeVar("G")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Kind:
    """What Python decides by in the work: work of one kind launches the same kernels.

    Args:
        addresses: where the tensors lie that it reads in place, and how many rows they have. When this changes, every recording
            is dropped.
        shapes, facts: whatever else Python looks at.
    """

    addresses: tuple[int, ...]
    shapes: tuple[Any, ...]
    facts: tuple[Any, ...]


def can_record(device: torch.device) -> bool:
    """Whether work on the device can be recorded."""
    return device.type in DEVICES


class Recorded(Generic[G, T]):
    """Work of one kind, which reads what it is given from tensors of its own.

    Args:
        recording: of the work. write: writes what a replay is given to where the work reads it.
    """

    def __init__(self, recording: Recording[Any], write: Callable[[G], None]) -> None:
        self._recording, self._write = recording, write

    def holds_at(self, t: int) -> bool:
        """Whether what Python has decided by the iteration, as a strategy may, is the same at t."""
        return self._recording.holds_at(t)

    def replay(self, given: G) -> bool:
        """Do the work with what it is given; False where the recording does not hold for it, before anything has changed."""
        self._write(given)
        return self._recording.replay()

    def outcome(self, given: G) -> T:
        """What the work has made."""
        raise NotImplementedError


class Replays:
    """The recordings of one training, or of the drawings of one thread.

    Args:
        name: of what ends where a recording fails, for the log.
        count: is told the reason whenever work is live.
    """

    def __init__(self, device: torch.device, name: str, count: Callable[[str], None] = lambda reason: None) -> None:
        self._device, self._name, self._count = device, name, count
        self._recorded: dict[Kind, Any] = {}  # None: to be recorded
        # What work that was live has in common with such whose tensors lie elsewhere.
        self._done = set[tuple[Any, ...]]()
        self._addresses: tuple[int, ...] = ()
        self._moves = 0  # changes of these since the last replay
        self._turns = 0.0  # how often a recording did not hold at its iteration, less what the replays since have saved
        self._failed = False

    def do(self, kind: Kind, t: int, given: Any, *, live: Callable[[], T], record: Callable[[], Recorded[Any, T]]) -> T:
        """Do the work: by a replay, while it is recorded, or live."""
        if self._failed:
            return self._live(live, _FAILED)
        if kind.addresses != self._addresses:  # the structure has changed, and with it everything that was recorded
            self._recorded.clear()
            self._addresses, self._moves = kind.addresses, self._moves + 1
            if self._moves == _RESTLESS:
                _log.warning(
                    "%s: nothing is replayed, so that on a GPU an iteration takes two to three times as long. In each one, the "
                    "number of Gaussians is another one, or a tensor of the field or of a strategy's state is a new one. Write "
                    "to Strategy.state in place, by copy_().",
                    self._name,
                )
        if kind not in self._recorded:
            if len(self._recorded) == _MOST_KINDS:
                return self._live(live, f"more than {_MOST_KINDS} kinds")
            self._recorded[kind] = None
            alike = len(kind.addresses), kind.shapes, kind.facts
            if alike not in self._done or self._moves > 1:  # where nothing lasts, a recording does not pay
                self._done.add(alike)
                with on_side_stream(self._device):  # some caches are of a stream
                    return self._live(live, "the first of its kind")
        try:
            known = self._recorded[kind]
            if known is not None and not known.holds_at(t):
                known, self._turns = None, self._turns + 1
                if self._turns > _MOST_TURNS:
                    raise RuntimeError(
                        "a strategy decides by the iteration, or by what it stores in Python, and again and again another way. "
                        "Numbers that it changes belong in tensors that it writes in place."
                    )
            recorded = record() if known is None else known if known.replay(given) else None
            if recorded is known is not None:
                self._moves, self._turns = 0, max(0.0, self._turns - 1 / _PAYS_AFTER)
            reason = "the recorded lists of pairs are too short"  # recorded anew, with space for more
        except Exception as error:
            self._failed, recorded, reason = True, None, _FAILED
            self._recorded.clear()
            cause = f"{type(error).__name__}: {error}".partition("\n")[0]
            _log.warning("%s ends at t=%d, and iterations are live from now on: %s", self._name, t, cause)
        self._recorded[kind] = recorded
        return self._live(live, reason) if recorded is None else recorded.outcome(given)

    def _live(self, live: Callable[[], T], reason: str) -> T:
        self._count(reason)
        return live()


def copied(x: Tensor | None) -> Tensor | None:
    return None if x is None else x.clone()


def write(own: Sequence[Tensor | None], given: Sequence[Tensor | None]) -> None:
    """Write what work is given to where the recorded one reads it: tensors of one type and layout by one kernel."""
    alike = defaultdict[torch.dtype, list[tuple[Tensor, Tensor]]](list)
    for x, y in zip(own, given, strict=True):
        if x is None or y is None:
            continue
        if x.dtype == y.dtype and x.stride() == y.stride():
            alike[x.dtype].append((x, y))
        else:
            x.copy_(y)
    for pairs in alike.values():
        torch._foreach_copy_([x for x, _ in pairs], [y for _, y in pairs])
