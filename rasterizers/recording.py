"""Work on CUDA that is recorded once and then done again without the Python that launched it.

A recording consists of CUDA graphs. A replay runs the same kernels on the same memory. What changes from one replay to the next
must lie in tensors that are written before it: a number that Python passed to a kernel or to torch is the same in every replay.
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
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

R = TypeVar("R")
T = TypeVar("T")

_CACHED: Final = 0.25
"""Of the free memory: as much may be cached when a recording begins."""


class Recording(Generic[T]):
    """What `work` did on the device. It is done once while it is recorded, and again by each `replay`.

    Args:
        device: the CUDA device of all tensors of `work`, which runs on a stream of its own.
        work: launches by torch and by `rasterizers.warp_runtime`. It must not read a number from the device, but in a `pause`.
            What it does once, such as to compile kernels or to fill caches, must have been done, in a scope of `on_side_stream`.

    Attributes:
        result: what `work` returned. Its tensors receive new values in every replay.
        guards: conditions on the iteration under which a replay holds, see `rasterizers.guards`.

    Raises:
        RuntimeError: `work` does what cannot be recorded. Live work can go on: the capture has been ended, and of the part
            that was being recorded nothing has been done.
    """

    def __init__(self, device: torch.device, work: Callable[[], T]) -> None:
        self._stream = _side_stream(device)
        self._pool = torch.cuda.graph_pool_handle()  # one for all graphs, since they run in order
        self._parts: list[tuple[Callable[[], None], Callable[[], bool]]] = []
        self.guards: list[Callable[[int], bool]] = []
        self._watch = _Watch(device.type)
        self._graph: Any = None  # which is being captured, and what ends that
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
        """End a part of the work, and return what the host reads of it.

        Args:
            read: called once, while nothing is recorded.
            holds: asked at this place of every replay, whether what was recorded after it holds for what was computed before it.
        """
        self._end(holds)
        found = read()
        self._begin()
        return found

    def launched(self, tensors: Iterable[Any]) -> None:
        """Note a launch that torch does not see, which reads and writes these tensors."""
        self._watch.keep(tensors)

    def holds_at(self, t: int) -> bool:
        """Whether what Python has decided by the iteration is the same at t."""
        return all(guard(t) for guard in self.guards)

    def replay(self) -> bool:
        """Do the work again; False: it ended at a `pause` where what was recorded does not hold."""
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
        self._graph.replay()  # to record is not to run
        self._parts.append((self._graph.replay, holds))


_failed: Final[list[Any]] = []
"""Graphs whose capture CUDA has ended by an error. Torch's allocator of pinned memory asks them later, whose they are."""


@contextmanager
def _captured_by(graph: Any, pool: Any, device: int) -> Iterator[None]:
    """A scope that ends the graph's capture. Where CUDA ends it by an error, torch goes on as within the capture: its allocator
    keeps what is cached, also where memory runs out, `torch.cuda.empty_cache` and random numbers raise. This undoes that.
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
            with suppress(AttributeError, RuntimeError):  # torch before 2.8; the allocator had been told
                torch._C._cuda_endAllocateToPool(device, pool)
                torch._C._cuda_releasePool(device, pool)
            generator.graphsafe_set_state(before)
            raise


def _make_room(device: torch.device) -> None:
    """Give cached memory back before it runs short. In a capture torch gives none back, and what dropped recordings leave in
    their pools nothing else can use.
    """
    cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    if cached > _CACHED * torch.cuda.mem_get_info(device)[0]:
        torch.cuda.empty_cache()


class _Watch(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Keeps the tensors that operations of torch read and write and that were allocated before, and refuses to read a number
    before CUDA does, which would make the capture invalid.
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
        if op.overloadpacket is torch.ops.aten._local_scalar_dense and args[0].device.type == self._device:
            raise RuntimeError("recorded work must not read a number from the device.")
        given, result = tree_leaves((args, kwargs)), op(*args, **kwargs)
        if not (op.is_view or op._schema.is_mutable):
            self._own |= _addresses(tree_leaves(result)) - _addresses(given)  # unsafe_split returns what it is given
        self.keep(given)
        return result


def _addresses(tensors: Iterable[Any]) -> set[int]:
    return {x.untyped_storage().data_ptr() for x in tensors if isinstance(x, Tensor)}


class _Running(threading.local):
    """What a thread is recording, and its side streams: work of another thread on one that is captured would be recorded, too."""

    recording: Recording[Any] | None = None

    def __init__(self) -> None:
        self.streams: dict[torch.device, Any] = {}


_running: Final = _Running()
_one_at_a_time: Final = threading.RLock()
"""Of recordings by several threads, since Warp's list of captures is that of all threads, and so is Python's collector."""


def running() -> Recording[Any] | None:
    """The recording that this thread is making."""
    return _running.recording


@contextmanager
def _running_as(recording: Recording[Any]) -> Iterator[None]:
    """A scope without Python's collector: what that frees may be memory or an event of CUDA, and so end a capture."""
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
    """A scope whose work runs on the stream that graphs are captured on, which torch's default stream cannot be: after what was
    launched before the scope, and before what is launched after it.
    """
    outer, side = torch.cuda.current_stream(device), _side_stream(device)
    side.wait_stream(outer)
    try:
        with torch.cuda.stream(side):
            yield
    finally:
        outer.wait_stream(side)


def _side_stream(device: torch.device) -> Any:
    """This thread's."""
    if device not in _running.streams:
        _running.streams[device] = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    return _running.streams[device]


@cache
def warp_stream(stream: Any) -> Any:
    """Torch's stream as a Warp stream. Cached, because Warp keeps the scratch memory of its sort with the stream."""
    import warp as wp

    wp.init()  # the recorded work may be torch's alone
    return wp.stream_from_torch(stream)
