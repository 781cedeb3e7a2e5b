"""Work on a device that is recorded once and then done again without the Python that launched it.

On CUDA a recording consists of CUDA graphs. On the CPU, where Warp's kernels run for tests, it consists of torch's operations
and of Warp's graphs between them. A replay runs the same kernels on the same memory. What changes from one replay to the next
must lie in tensors that are written before it: a number that Python passed to a kernel or to torch is the same in every replay.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache, partial
from typing import Any, Final, Generic, TypeVar, cast

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

R = TypeVar("R")
T = TypeVar("T")


class Recording(Generic[T]):
    """What `work` did on the device. It is done once while it is recorded, and again by each `replay`.

    Args:
        device: the device of all tensors of `work`, which runs on torch's current stream.
        work: launches by torch and by `rasterizers.warp_runtime`. It must not read a number from the device, but in a `pause`.
            What it does once, such as to compile kernels or to fill caches, must have been done.

    Attributes:
        result: what `work` returned. Its tensors receive new values in every replay.

    Raises:
        RuntimeError: `work` does what cannot be recorded.
    """

    def __init__(self, device: torch.device, work: Callable[[], T]) -> None:
        self._parts: list[tuple[Callable[[], None], Callable[[], bool]]] = []
        self._recorder: _Recorder = _Graphs(device) if device.type == "cuda" else _Calls()
        _running.recording = self
        try:
            with self._recorder.scope(), self._recorder:
                self._begin()
                self.result = work()
                self._end(lambda: True)
        finally:
            _running.recording = None

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

    def _begin(self) -> None:
        self._recorder.begin()
        self._recorder.active = True

    def _end(self, holds: Callable[[], bool]) -> None:
        self._recorder.active = False
        self._parts.append((self._recorder.end(), holds))

    def launched(self, again: Callable[[], Callable[[], Any]], tensors: Iterable[Any]) -> None:
        """Add a launch that torch does not see. It has been made, and reads and writes these tensors.

        Args:
            again: makes what launches again, where a graph does not do that.
        """
        self._recorder.launched(again, tensors)

    def replay(self) -> bool:
        """Do the work again; False: it ended at a `pause` where what was recorded does not hold."""
        for work, holds in self._parts:
            work()
            if not holds():
                return False
        return True


class _Running(threading.local):
    recording: Recording[Any] | None = None


_running: Final = _Running()


def running() -> Recording[Any] | None:
    """The recording that this thread is making."""
    return _running.recording


class _Recorder(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Records while it is entered. Each operation of torch calls it, and it keeps the tensors that were allocated before."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._own: set[int] = set()  # addresses of the memory that the work has allocated
        self._kept: list[Any] = []
        self.active = False

    def scope(self) -> AbstractContextManager[Any]:
        return nullcontext()

    def begin(self) -> None:
        raise NotImplementedError

    def end(self) -> Callable[[], None]:
        """End a part; returns what does it again."""
        raise NotImplementedError

    def launched(self, again: Callable[[], Callable[[], Any]], tensors: Iterable[Any]) -> None:
        self._keep(tensors)

    def _keep(self, tensors: Iterable[Any]) -> None:
        self._kept += [x for x in tensors if isinstance(x, Tensor) and x.untyped_storage().data_ptr() not in self._own]

    def __torch_dispatch__(self, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        call = partial(op, *args, **(kwargs or {}))
        result = call()
        if not self.active:
            return result
        if op.overloadpacket is torch.ops.aten._local_scalar_dense:
            raise RuntimeError("recorded work must not read a number from the device.")
        made = [x for x in tree_leaves(result) if isinstance(x, Tensor)]
        if not (op.is_view or op._schema.is_mutable):
            self._own |= {x.untyped_storage().data_ptr() for x in made}
        self.called(op, call, made)
        self._keep(tree_leaves((args, kwargs)))
        return result

    def called(self, op: Any, call: Callable[[], Any], made: list[Tensor]) -> None:
        """An operation of torch that has returned these tensors."""


class _Graphs(_Recorder):  # type: ignore[no-untyped-call]
    """Records CUDA graphs. All of them take their memory from one pool, since they run in order."""

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self._stream = _side_stream(device)
        self._pool: Any = None
        self._capturing: tuple[Any, Any] | None = None  # torch's graph, and Warp's stream

    @contextmanager
    def scope(self) -> Iterator[None]:
        outer = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(outer)
        try:
            with torch.cuda.stream(self._stream):
                yield
        finally:
            if self._capturing is not None:  # the work failed, and so may this
                with suppress(RuntimeError):
                    self._end_capture()
            outer.wait_stream(self._stream)

    def begin(self) -> None:
        import warp as wp

        stream, graph = warp_stream(self._stream), cast(Any, torch.cuda.CUDAGraph())
        graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
        self._capturing, self._pool = (graph, stream), graph.pool()
        wp.capture_begin(stream=stream, external=True)  # else the memory of Warp's sort would leak

    def end(self) -> Callable[[], None]:
        graph = self._end_capture()
        graph.replay()  # to record is not to run
        replay: Callable[[], None] = graph.replay
        return replay

    def _end_capture(self) -> Any:
        import warp as wp

        (graph, stream), self._capturing = cast(tuple[Any, Any], self._capturing), None
        try:
            self._kept.append(wp.capture_end(stream=stream))
        finally:
            graph.capture_end()
        return graph


@cache
def _side_stream(device: torch.device) -> Any:
    """The stream that graphs are captured on, which torch's default stream cannot be."""
    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


@cache
def warp_stream(stream: torch.cuda.Stream) -> Any:
    """Torch's stream as a Warp stream. Cached, because Warp keeps the scratch memory of its sort with the stream."""
    import warp as wp

    return wp.stream_from_torch(stream)


class _Calls(_Recorder):  # type: ignore[no-untyped-call]
    """Records the calls, and makes them. Launches between two operations of torch become one graph of Warp's."""

    def begin(self) -> None:
        self._again: list[Callable[[], Any]] = []
        self._launches: list[Callable[[], Any]] = []

    def end(self) -> Callable[[], None]:
        self._join()
        calls = self._again

        def replay() -> None:
            for call in calls:
                call()

        return replay

    def launched(self, again: Callable[[], Callable[[], Any]], tensors: Iterable[Any]) -> None:
        self._keep(tensors)
        self._launches.append(again())

    def _join(self) -> None:
        if not self._launches:
            return
        import warp as wp

        wp.capture_begin(device="cpu")  # on a CPU to capture is not to run, either
        for launch in self._launches:
            launch()
        self._again.append(partial(wp.capture_launch, wp.capture_end(device="cpu")))
        self._launches = []

    def called(self, op: Any, call: Callable[[], Any], made: list[Tensor]) -> None:
        self._kept.append(made)
        if op._schema.is_mutable:
            self._join()
            self._again.append(call)
        elif made and not op.is_view and not op.overloadpacket.__name__.startswith(("empty", "new_empty")):
            self._join()
            self._again.append(partial(_written_anew, made, call))


def _written_anew(made: list[Tensor], call: Callable[[], Any]) -> None:
    for tensor, value in zip(made, tree_leaves(call()), strict=True):
        tensor.copy_(value)
