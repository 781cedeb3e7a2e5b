"""Work on CUDA that is recorded once as CUDA graphs, and replayed without the Python that launched it.

A replay runs the same kernels on the same memory. What changes from one replay to the next must be written to tensors before it,
since a number that Python passed to a kernel or to torch is the same in every replay.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from typing import Any, Final, Generic, TypeVar, cast

import torch
from torch import Tensor

from rasterizers.torch_internals import TorchDispatchMode, end_failed_pool, reads_number, tree_leaves, writes

R = TypeVar("R")
T = TypeVar("T")

_CACHED: Final = 0.25
"""The share of the free memory that torch may have cached when a recording begins."""


class Recording(Generic[T]):
    """The launches of `work` on the device, which run once after they are recorded, and again in each `replay`.

    Args:
        device: the CUDA device of all tensors of `work`, which runs on a stream of its own.
        work: launches by torch and by `rasterizers.warp_runtime`. It may read numbers from the device only in a `pause`. Kernels
            must have been compiled and caches filled before, in a scope of `on_side_stream`.

    Attributes:
        result: what `work` returned. Every replay overwrites its tensors.
        guards: conditions on the iteration under which a replay holds, see `rasterizers.guards`.

    Raises:
        RuntimeError: `work` cannot be recorded. The capture has been ended, nothing of the part that was being recorded has run,
            and the work can be done live.
    """

    def __init__(self, device: torch.device, work: Callable[[], T]) -> None:
        self._stream = _side_stream(device)
        self._pool = torch.cuda.graph_pool_handle()  # one for all graphs, since they run in order
        self._parts: list[tuple[Callable[[], None], Callable[[], bool]]] = []
        self.guards: list[Callable[[int], bool]] = []
        self._watch = _Watch(device.type)
        self._graph: Any = None  # the graph that is being captured, and what ends the capture
        self._ends = ExitStack()
        with _one_at_a_time, on_side_stream(device), _running_as(self):
            try:
                _make_room(device)
                self._begin()
                self.result = work()
                self._end(lambda: True)
            except BaseException:
                with suppress(Exception):  # a capture that failed is ended by an error, too
                    self._ends.close()
                raise

    def pause(self, read: Callable[[], R], holds: Callable[[], bool]) -> R:
        """End a graph, let the host read from the device, and begin the next graph.

        Args:
            read: called once, while nothing is recorded; its result is returned.
            holds: called at this place of every replay: whether the later graphs hold for what the earlier ones have computed.
        """
        self._end(holds)
        found = read()
        self._begin()
        return found

    def launched(self, tensors: Iterable[Any]) -> None:
        """Keep alive the tensors of a launch that torch does not see."""
        self._watch.keep(tensors)

    def holds_at(self, t: int) -> bool:
        """Return True if Python decides at t as it did in the recording: all guards hold."""
        return all(guard(t) for guard in self.guards)

    def replay(self) -> bool:
        """Do the work again; False: it ended at a `pause` after which the recording does not hold."""
        for work, holds in self._parts:
            work()
            if not holds():
                return False
        return True

    def _begin(self) -> None:
        import warp as wp

        graph, stream, ends = cast(Any, torch.cuda.CUDAGraph()), warp_stream(self._stream), self._ends
        self._graph = graph
        ends.enter_context(_captured_by(graph, self._pool, self._stream.device.index))  # before anything can fail
        graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
        ends.callback(lambda: self._watch.kept.append(wp.capture_end(stream=stream)))
        wp.capture_begin(stream=stream, external=True)  # else the memory of Warp's sort would leak
        ends.enter_context(self._watch)

    def _end(self, holds: Callable[[], bool]) -> None:
        self._ends.close()
        self._graph.replay()  # capturing runs nothing
        self._parts.append((self._graph.replay, holds))


_failed: Final[list[Any]] = []
"""Graphs whose capture CUDA ended with an error, kept alive since torch's allocator of pinned memory refers to them later."""


@contextmanager
def _captured_by(graph: Any, pool: Any, device: int) -> Iterator[None]:
    """A scope that ends the graph's capture. If CUDA ends it with an error, torch stays in the state of a capture: its allocator
    frees no cached memory, even if memory runs out, and `torch.cuda.empty_cache` and random numbers raise. The scope undoes that.
    """
    generator: Any = torch.cuda.default_generators[device]
    before = generator.clone_state()
    try:
        yield
    finally:
        try:
            graph.capture_end()
        except BaseException:
            _failed.append(graph)
            end_failed_pool(device, pool)
            generator.graphsafe_set_state(before)
            raise


def _make_room(device: torch.device) -> None:
    """Free cached memory before it runs short: torch frees none in a capture, and nothing else can use the memory that dropped
    recordings leave in their pools.
    """
    cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    if cached > _CACHED * torch.cuda.mem_get_info(device)[0]:
        torch.cuda.empty_cache()


class _Watch(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Keeps alive the tensors that torch's operations read or write and that were allocated before the recording. Refuses to read
    a number from the device before CUDA does, which would invalidate the capture.
    """

    def __init__(self, device: str) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._device = device
        self._own: set[int] = set()  # addresses of the memory that the work has allocated
        self.kept: list[Any] = []

    def keep(self, tensors: Iterable[Any]) -> None:
        self.kept += [x for x in tensors if isinstance(x, Tensor) and x.untyped_storage().data_ptr() not in self._own]

    def __torch_dispatch__(self, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if reads_number(op) and args[0].device.type == self._device:
            raise RuntimeError("recorded work must not read a number from the device.")
        given, result = tree_leaves((args, kwargs)), op(*args, **kwargs)
        if not (op.is_view or writes(op)):
            self._own |= _addresses(tree_leaves(result)) - _addresses(given)  # unsafe_split returns its input
        self.keep(given)
        return result


def _addresses(tensors: Iterable[Any]) -> set[int]:
    return {x.untyped_storage().data_ptr() for x in tensors if isinstance(x, Tensor)}


class _Running(threading.local):
    """A thread's recording and its side streams: a capture would record another thread's work on the same stream, too."""

    recording: Recording[Any] | None = None

    def __init__(self) -> None:
        self.streams: dict[torch.device, Any] = {}


_running: Final = _Running()
_one_at_a_time: Final = threading.RLock()
"""Threads record one at a time, since they share Warp's list of captures and Python's garbage collector."""


def running() -> Recording[Any] | None:
    """The recording that this thread is making."""
    return _running.recording


@contextmanager
def _running_as(recording: Recording[Any]) -> Iterator[None]:
    """A scope without Python's garbage collector, which may free memory or an event of CUDA, and so end the capture."""
    collects = gc.isenabled()
    gc.disable()
    _running.recording = recording
    try:
        yield
    finally:
        _running.recording = None
        if collects:
            gc.enable()


@contextmanager
def on_side_stream(device: torch.device) -> Iterator[None]:
    """A scope whose work runs on the stream for captures, which cannot be torch's default stream. It is ordered after all work
    launched before the scope, and before all work launched after it.
    """
    outer, side = torch.cuda.current_stream(device), _side_stream(device)
    side.wait_stream(outer)
    try:
        with torch.cuda.stream(side):
            yield
    finally:
        outer.wait_stream(side)


def _side_stream(device: torch.device) -> Any:
    """This thread's stream for captures."""
    if device not in _running.streams:
        _running.streams[device] = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    return _running.streams[device]


@cache
def warp_stream(stream: Any) -> Any:
    """Torch's stream as a Warp stream. It is cached, because Warp stores the scratch memory of its sort with the stream."""
    import warp as wp

    wp.init()  # the recorded work may be torch's alone
    return wp.stream_from_torch(stream)
