"""CUDA in torch means the CPU: the device "cuda", `.cuda()`, and what trainers call of `torch.cuda`."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, Final

import torch
from torch.overrides import TorchFunctionMode

from clear_strategies.core.work_log import peak_mib

_CPU: Final = torch.device("cpu")
_WITHOUT_EFFECT: Final = (
    "init", "ipc_collect", "reset_max_memory_allocated", "reset_max_memory_cached", "reset_peak_memory_stats", "set_device",
    "synchronize",
)  # fmt: skip
_MEMORY: Final = ("max_memory_allocated", "max_memory_reserved", "memory_allocated", "memory_reserved")
_TENSORS: Final = ("BoolTensor", "ByteTensor", "DoubleTensor", "FloatTensor", "HalfTensor", "IntTensor", "LongTensor")


def replace() -> None:
    """From here on CUDA means the CPU, in this process and in those that it forks.

    `torch.cuda.is_available()` stays false, and what is not replaced raises torch's own errors. `torch.compile` compiles nothing
    unless the environment says so: it takes longer than the small functions that trainers compile, and needs a C++ compiler.
    """
    os.environ.setdefault("TORCHDYNAMO_DISABLE", "1")
    _CudaIsTheCpu().__enter__()  # type: ignore[no-untyped-call]
    _replace(threading.Thread, "start", _started_with_it)
    if "fork" in multiprocessing.get_all_start_methods():  # a process that is started anew has none of this
        multiprocessing.set_start_method("fork", force=True)
    _replace(torch, "load", lambda load: lambda file, map_location=None, *args, **kwargs: load(
        file, "cpu" if map_location is None else _on_cpu(map_location), *args, **kwargs
    ))  # fmt: skip
    for name in ("set_default_device", "set_default_tensor_type"):
        _replace(torch, name, lambda function: lambda kind: function(_on_cpu(kind)))
    ours = {
        **{name: lambda *_, **__: None for name in _WITHOUT_EFFECT},  # each its own: dynamo refuses one by two names
        **{name: lambda *_, **__: peak_mib() << 20 for name in _MEMORY},
        **{name: getattr(torch, name) for name in _TENSORS},
        "Event": Event, "device": nullcontext, "current_device": lambda: 0, "get_device_name": lambda *_: "CPU",
    }  # fmt: skip
    for name, value in ours.items():
        setattr(torch.cuda, name, value)


def _replace(owner: Any, name: str, make: Callable[[Any], Any]) -> None:
    setattr(owner, name, make(getattr(owner, name)))


def _on_cpu(x: Any) -> Any:
    if isinstance(x, torch.device):
        return _CPU if x.type == "cuda" else x
    if isinstance(x, str) and x.startswith("torch.cuda."):
        return x.replace("torch.cuda.", "torch.")
    return "cpu" if isinstance(x, str) and (x == "cuda" or x.startswith("cuda:")) else x


class _CudaIsTheCpu(TorchFunctionMode):
    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function is torch.Tensor.pin_memory:
            return args[0]
        if function is torch.Tensor.cuda:
            return _without_gaps(args[0])
        named = {name: _on_cpu(x) for name, x in (kwargs or {}).items() if name != "pin_memory"}
        if isinstance(named.get("device"), int):
            named["device"] = _CPU
        if function is torch.Tensor.to and len(args) > 1 and isinstance(args[1], int):
            args = (args[0], _CPU, *args[2:])
        if function is torch.device and args and _on_cpu(args[0]) != args[0]:
            return _CPU  # without an index, as the device of the tensors
        result = function(*map(_on_cpu, args), **named)
        moved = function is torch.Tensor.to and any(isinstance(x, str | torch.device) for x in (*args, *named.values()))
        return _without_gaps(result) if moved else result


def _without_gaps(x: torch.Tensor) -> torch.Tensor:
    """The tensor, as another device gets it: rows with gaps between them are copied. Adam(fused=True) does not see gaps here."""
    return x if torch.empty_like(x).stride() == x.stride() else x.contiguous()


def _started_with_it(start: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
    """Threads have modes of their own."""

    def started(thread: threading.Thread) -> None:
        run = thread.run

        def run_with_it() -> None:
            with _CudaIsTheCpu():
                run()

        thread.run = run_with_it  # type: ignore[method-assign]
        start(thread)

    return started


class Event:
    """`torch.cuda.Event` by the clock. Nothing runs behind the program's back, so that all of it is done, always."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self._time = 0.0

    def record(self, *_: Any) -> None:
        self._time = time.perf_counter()

    def elapsed_time(self, other: Event) -> float:
        """Milliseconds from this event to the other."""
        return 1_000 * (other._time - self._time)

    def query(self) -> bool:
        return True

    def synchronize(self, *_: Any) -> None:
        pass

    wait = synchronize
