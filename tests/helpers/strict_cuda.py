"""A stand-in for CUDA's streams and graphs, for tensors in the CPU's memory, which refuses what `cuda_rules` says.

As on a GPU, what is captured is not done: results are NaN or 0 until a replay. A graph does not keep the memory that it reads.
Backward passes run in a thread of their own, which sees the modes of the thread that asked for them, but not its other state.
"""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial, wraps
from typing import Any, Final

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes, _get_current_dispatch_mode_stack
from torch.utils._pytree import tree_leaves, tree_map

from rasterizers.interface import BackendUnavailable
from tests.helpers.cuda_rules import ROOM, RULES, Act, State


class Pool(dict[int, torch.Tensor]):
    """Memory of graphs, by address. None of it is used a second time."""

    used = False


@dataclass(eq=False)
class Stream:
    """A `torch.cuda.Stream`."""

    cuda: StrictCuda
    records: bool = False
    device = torch.device("cpu", 0)

    def wait_stream(self, other: Stream) -> None:
        self.cuda.ask("wait", on=self, other=other)


class Event:
    """A `torch.cuda.Event`."""

    def __init__(self, cuda: StrictCuda, enable_timing: bool = False) -> None:
        self.cuda = cuda

    def record(self, stream: Stream | None = None) -> None:
        self.cuda.ask("event", on=stream)

    def query(self) -> bool:
        self.cuda.ask("read")
        return True

    synchronize = query

    def elapsed_time(self, end: Event) -> float:
        return 1.0


class StrictCuda:
    """The device: one at a time, see `installed`."""

    def __init__(self) -> None:
        self.current = Stream(self)
        self.state = State(self.current)
        self.backward: int | None = None  # autograd's thread of the device

    def ask(self, what: str, on: Stream | None = None, **more: Any) -> None:
        """Refuse the act where a rule does."""
        act, capture = Act(what, on or self.current, **more), self.state.capture
        for rule in RULES.values():
            if rule.of in ("", what) and rule.refuses(act, self.state):
                if capture is not None and not rule.check:
                    capture.invalid = True
                raise RuntimeError(rule.message)

    def do(self, call: Callable[..., Any], *arguments: Any) -> None:
        """Call, or note the call of what is captured."""
        if (graph := self.state.capture) is None:
            call(*arguments)
        else:
            graph.calls.append((call, tree_map(graph.reference, arguments)))

    def free(self, device: Any = None) -> tuple[int, int]:
        """`torch.cuda.mem_get_info`, in pools."""
        return max(0, ROOM - self.state.living - self.state.cached), ROOM

    def empty_cache(self) -> None:
        self.ask("empty")
        self.state.cached = 0

    def lets_go(self, what: str, on: Stream | None = None) -> None:
        """Ask as a destructor does, which raises nothing; a capture is invalid all the same."""
        with contextlib.suppress(RuntimeError):
            self.ask(what, on)

    def set_sync_debug_mode(self, mode: str) -> None:
        """`torch.cuda.set_sync_debug_mode`."""
        self.state.no_waits = mode == "error"

    def end_allocate(self, device: int, pool: Pool) -> None:
        """`torch._C._cuda_endAllocateToPool`."""
        if all(x is not pool for x in self.state.underway):
            raise RuntimeError("endAllocatePool: not currently recording to mempool_id")
        self.state.underway = [x for x in self.state.underway if x is not pool]

    @contextlib.contextmanager
    def using(self, stream: Stream) -> Iterator[None]:
        """`torch.cuda.stream`."""
        outer, self.current = self.current, stream
        try:
            yield
        finally:
            self.current = outer


class Graph:
    """A `torch.cuda.CUDAGraph`."""

    def __init__(self, cuda: StrictCuda) -> None:
        self.cuda, self.stream = cuda, cuda.current
        self.captured = self.invalid = False
        self.thread, self.mode = threading.get_ident(), "global"
        self.calls: list[tuple[Callable[..., Any], Any]] = []
        self.pooled = Pool()
        self.on_host: dict[int, torch.Tensor] = {}  # what a generator of the CPU has drawn meanwhile, which may be read

    def capture_begin(self, pool: Pool | None = None, capture_error_mode: str = "global") -> None:
        self.cuda.ask("begin", graph=self)
        self.pooled, state = Pool() if pool is None else pool, self.cuda.state
        if not self.pooled.used:
            self.pooled.used, state.living = True, state.living + 1
            weakref.finalize(self.pooled, state.drop)
        self.stream, state.capture, state.seeds = self.cuda.current, self, True
        self.mode = capture_error_mode
        state.underway.append(self.pooled)

    def capture_end(self) -> None:
        self.cuda.ask("end", graph=self)
        self.cuda.state.capture = None
        if self.invalid:
            raise RuntimeError("Operation failed due to a previous error during capture.")
        self.cuda.end_allocate(0, self.pooled)
        self.cuda.state.seeds, self.captured = False, True
        weakref.finalize(self, self.cuda.lets_go, "destroy")

    def pool(self) -> Pool:
        self.cuda.ask("pool", graph=self)
        return self.pooled

    def replay(self) -> None:
        arguments = [tree_map(_referent, given) for _, given in self.calls]
        self.cuda.ask("replay", graph=self, freed=any(x is _FREED for x in tree_leaves(arguments)))
        with _disable_current_modes(), torch.no_grad():
            for (call, _), given in zip(self.calls, arguments, strict=True):
                call(*given)

    def may_be_read(self, x: torch.Tensor) -> bool:
        """Whether a tensor is on the host; or the thread is another one, which in the mode thread_local may wait."""
        is_others = threading.get_ident() not in (self.thread, self.cuda.backward)
        return _address(x) in self.on_host or (is_others and self.mode == "thread_local")

    def reference(self, x: Any) -> Any:
        """A tensor of the pool itself; a weak reference to another, which others have to keep."""
        return weakref.ref(x) if isinstance(x, torch.Tensor) and _address(x) not in self.pooled else x


_FREED: Final = object()


def _referent(x: Any) -> Any:
    if not isinstance(x, weakref.ref):
        return x
    return _FREED if (tensor := x()) is None else tensor


def _address(x: torch.Tensor) -> int:
    return x.untyped_storage().data_ptr()


def _tensors(tree: Any) -> list[torch.Tensor]:
    """Of what an operation is given or returns: tuples, lists and dictionaries. Torch's own tree_leaves takes longer."""
    if isinstance(tree, torch.Tensor):
        return [tree]
    inner = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, (tuple, list)) else ()
    return [x for part in inner for x in _tensors(part)]


class _Operations(TorchDispatchMode):
    """Torch's operations: asked, and in a capture noted in place of done."""

    def __init__(self, cuda: StrictCuda) -> None:
        super().__init__()
        self.cuda = cuda

    def __torch_dispatch__(self, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        cuda, graph, kwargs = self.cuda, self.cuda.state.capture, kwargs or {}
        if torch.Tag.nondeterministic_seeded in op.tags and kwargs.get("generator") is None:
            cuda.ask("random")
        if torch.is_grad_enabled() and any(x.requires_grad for x in _tensors((args, kwargs))):
            cuda.ask("graph")
        if graph is None:
            return op(*args, **kwargs)
        if kwargs.get("generator") is not None:
            drawn = op(*args, **kwargs)
            graph.on_host[_address(drawn)] = drawn
            return drawn
        name = op.overloadpacket.__name__
        is_masked = name.startswith(("index", "_index")) and any(x.dtype == torch.bool for x in _tensors(args[1:2]))
        tells = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(op.tags)
        if is_masked or tells or name == "_linalg_check_errors":
            cuda.ask("read")
        if name.startswith("lift_fresh"):
            cuda.ask("send")
        if op.is_view:
            return op(*args, **kwargs)
        if op._schema.is_mutable:
            cuda.ask("work")
            cuda.do(lambda args, kwargs: op(*args, **kwargs), args, kwargs)
            return _written(op._schema, args, kwargs)
        cuda.ask("allocate")
        cuda.ask("work")
        result = op(*args, **kwargs)  # for its shape
        made, theirs = _tensors(result), {_address(x) for x in _tensors((args, kwargs))}
        for x in made:
            if _address(x) not in theirs:
                graph.pooled[_address(x)] = x.detach().fill_(torch.nan if x.is_floating_point() else 0)
        if not name.startswith(("empty", "new_empty", "unsafe_split")):  # whose results are not written, or views
            cuda.do(partial(_write_anew, op), made, args, kwargs)
        return result


def _written(schema: Any, args: Any, kwargs: Any) -> Any:
    """What an operation returns that writes to its arguments: these."""
    given = dict(zip((a.name for a in schema.arguments), args, strict=False)) | kwargs
    written = [given[a.name] for a in schema.arguments if a.alias_info is not None and a.alias_info.is_write]
    returned = tuple(written[: len(schema.returns)])
    return returned[0] if len(returned) == 1 else returned or None


def _write_anew(op: Any, made: list[torch.Tensor], args: Any, kwargs: Any) -> None:
    for tensor, value in zip(made, tree_leaves(op(*args, **kwargs)), strict=True):
        tensor.copy_(value)


_ACTS: Final = {"tolist": "read", "numpy": "read", "cpu": "read", "pin_memory": "pin", "new_tensor": "send"}


def _asks(cuda: StrictCuda, name: str, act: str) -> Callable[..., Any]:
    """A method of tensors that does on a CPU without an operation what it does on CUDA, for all threads."""
    method = getattr(torch.Tensor, name)

    @wraps(method)
    def asked(x: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        if (graph := cuda.state.capture) is None or not graph.may_be_read(x):
            cuda.ask(act)
        return x if act == "pin" else method(x, *args, **kwargs)

    return asked


class _Generator:
    """One of `torch.cuda.default_generators`, or its state."""

    def __init__(self, state: State) -> None:
        self._state, self._seeds = state, state.seeds

    def clone_state(self) -> _Generator:
        return _Generator(self._state)

    def graphsafe_set_state(self, other: _Generator) -> None:
        self._state.seeds = other._seeds


class _Elsewhere:
    """A thread that does what is called, as autograd's own of a device: thread-local state of the caller is not there."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1)
        self.ident = self._thread.submit(threading.get_ident).result()

    def does(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() == self.ident:
                return function(*args, **kwargs)
            modes = _get_current_dispatch_mode_stack()  # autograd takes these along, and no modes of functions
            return self._thread.submit(self._within, modes, partial(function, *args, **kwargs)).result()

        return call

    def close(self) -> None:
        self._thread.shutdown()

    @staticmethod
    def _within(modes: list[Any], function: Callable[[], Any]) -> Any:
        with contextlib.ExitStack() as stack:
            for mode in modes:
                stack.enter_context(mode)
            return function()


@contextlib.contextmanager
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[StrictCuda]:
    """A scope in which torch, Warp and this package take the CPU for a CUDA device."""
    import warp as wp

    import rasterizers.native
    from clear_strategies.core import deferred
    from clear_strategies.kernels import native
    from clear_strategies.merging import replay
    from rasterizers import recording, replayed_drawing, sending, warp_runtime
    from rasterizers.warp_backend import frame

    cuda, autograd, loaded = StrictCuda(), _Elsewhere(), set[Any]()
    construct, state, cuda.backward = warp_runtime._Launch.__init__, cuda.state, autograd.ident
    sort, prepare, allocate, init = wp.utils.radix_sort_pairs, warp_runtime._Launch.prepare, wp.empty, wp.init

    def initialises() -> None:
        init()
        cuda.state.warp_runs = True

    def warp_stream(stream: Stream) -> Stream:
        cuda.ask("warp stream", on=stream)
        return stream

    def warp_begins(*, stream: Stream, external: bool) -> None:
        cuda.ask("warp begin", on=stream)
        cuda.state.warp_knows = True

    def warp_ends(*, stream: Stream) -> None:
        cuda.ask("warp end", on=stream)
        cuda.state.warp_knows = False

    def sorts(keys: Any, values: Any, count: int, end_bit: int) -> None:
        cuda.ask("sort")
        arrays = [wp.array(ptr=x.ptr, shape=x.shape, dtype=x.dtype, device=x.device) for x in (keys, values)]
        cuda.do(lambda: sort(*arrays, count, end_bit=end_bit))

    def constructed(launcher: Any, kernel: Any, device: Any, block: int) -> None:
        if (kernel, block) not in loaded:
            cuda.ask("load")
            loaded.add((kernel, block))
        construct(launcher, kernel, device, block)

    def prepared(launcher: Any, size: Any, arguments: Any) -> Any:
        def launch() -> None:
            cuda.ask("work")
            cuda.do(lambda *given: prepare(launcher, size, given).launch(), *arguments)

        return type("Command", (), {"launch": staticmethod(lambda stream: launch())})

    def allocates(*args: Any, **kwargs: Any) -> Any:
        cuda.ask("allocate", by_warp=True)
        return allocate(*args, **kwargs)

    def sends(numbers: Any, device: Any) -> Any:
        cuda.ask("pin")
        return numbers

    def reads(numbers: torch.Tensor) -> Callable[[], Any]:
        cuda.ask("pin")
        copied = numbers.clone()

        def wait() -> Any:
            return copied.tolist()

        weakref.finalize(wait, cuda.lets_go, "unpin", cuda.current)
        return wait

    def on_no_cpu(*_: Any) -> Any:
        raise BackendUnavailable("this memory is the CPU's")

    patches: dict[Any, dict[str, Any]] = {
        torch.cuda: {
            "CUDAGraph": partial(Graph, cuda), "Event": partial(Event, cuda), "stream": cuda.using,
            "current_stream": lambda device: cuda.current, "graph_pool_handle": Pool,
            "synchronize": lambda device=None: cuda.ask("read"), "mem_get_info": cuda.free,
            "memory_reserved": lambda device=None: state.living + state.cached,
            "memory_allocated": lambda device=None: state.living, "empty_cache": cuda.empty_cache,
            "set_sync_debug_mode": cuda.set_sync_debug_mode,
            "default_generators": (_Generator(state),),
        },
        torch.Tensor: {name: _asks(cuda, name, act) for name, act in _ACTS.items()},
        torch._C: {"_cuda_endAllocateToPool": cuda.end_allocate, "_cuda_releasePool": lambda device, pool: None},
        wp: {
            "init": initialises, "stream_from_torch": warp_stream, "capture_begin": warp_begins, "capture_end": warp_ends,
            "empty": allocates,
        },
        torch.autograd: {name: autograd.does(getattr(torch.autograd, name)) for name in ("backward", "grad")},
        wp.utils: {"radix_sort_pairs": sorts},
        warp_runtime._Launch: {"__init__": constructed, "prepare": prepared},
        recording: {"_side_stream": cache(lambda device: Stream(cuda, records=True))},
        deferred: {"is_immediate": lambda x: False},
        native: {"available": lambda: False, "fastest": lambda device: "warp"},
        replay: {"can_record": lambda device: True},
        replayed_drawing: {"can_record": lambda device: True, "_thread": replayed_drawing._Thread()},
        rasterizers.native: {"empty": on_no_cpu},
        frame: {"_read_deferred": reads},
        sending: {"sent": sends},
        warp_runtime: {"sent": sends, "_kept": warp_runtime._Kept()},
    }  # fmt: skip
    for owner, values in patches.items():
        for name, value in values.items():
            # Before 2.8, torch needs no end of a pool.
            monkeypatch.setattr(owner, name, value, raising=owner is not torch._C)
    with contextlib.closing(autograd), _Operations(cuda):
        yield cuda
