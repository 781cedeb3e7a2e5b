"""Shared by all Warp code: a check that Warp runs here, torch tensors as kernel arguments, launches, and torch's stream.

Used by `rasterizers.warp_backend` and by the Warp kernels in `clear_strategies.kernels`. Imports Warp only when called.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache, lru_cache
from itertools import pairwise
from typing import Any, Final

import torch
from torch import Tensor

from rasterizers.interface import BackendUnavailable
from rasterizers.recording import running, warp_stream
from rasterizers.sending import sent


def require_warp(what: str, device: str, otherwise: str) -> None:
    """Check that Warp can run `what`, before it is imported, and silence Warp's output on stdout.

    Args:
        what: names the caller in the error message.
        device: "cuda" or "cpu".
        otherwise: says in the error message what runs without CUDA.

    Raises:
        BackendUnavailable: Warp is not installed or too old, or there is no CUDA device.
    """
    install = "pip install -U 'clear-strategies[warp]'"
    try:
        import warp as wp
    except ImportError as error:
        raise BackendUnavailable(f"{what} needs NVIDIA Warp, which is not installed ({error}); {install}.") from error
    major, minor, *_ = wp.config.version.split(".")
    # 1.17 does not compile `ellipses[listed[pair]]`. Until 1.16, a sort may free the memory in which a CUDA graph sorts, and a
    # replay would read it (NVIDIA/warp#1373).
    if (int(major), int(minor)) < (1, 18):
        raise BackendUnavailable(f"{what} needs NVIDIA Warp 1.18 or later, got {wp.config.version}; {install}.")
    # Warp would print a greeting and a line per compilation to stdout, which belongs to the application.
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    if device != "cuda":
        return
    missing = None
    if not torch.cuda.is_available():
        missing = "torch finds no CUDA device. Install NVIDIA's driver and a torch built for CUDA"
    elif wp.get_cuda_device_count() == 0:
        missing = "torch finds a CUDA device, Warp does not. Update NVIDIA's driver or warp-lang"
    if missing:
        raise BackendUnavailable(f"{what} cannot run on CUDA: {missing}; {otherwise}.")


@cache
def runs_warp() -> bool:
    """Return True if Warp runs on CUDA."""
    try:
        require_warp("a kernel", "cuda", "torch computes the same")
    except BackendUnavailable:
        return False
    return True


def lanes_on(device: torch.device, block: int) -> int:
    """The number of threads in a block on this device: `block` on CUDA; on a CPU 1, unless Warp's configuration allows more."""
    import warp as wp

    return block if device.type == "cuda" or getattr(wp.config, "enable_cpu_blocks", False) else 1


def launch(
    kernel: Any, dim: Sequence[int], arguments: Sequence[Any], *, block: int = 256, together: bool = False
) -> None:  # fmt: skip
    """Launch a kernel with a thread for each index of `dim`, on the device of its tensors.

    Does the same as `wp.launch` in a fifth of the host's time, which on CUDA exceeds the kernels': the layouts of arrays are
    kept. With an empty `dim` it only compiles and loads the kernel, which a recording cannot.

    Args:
        arguments: numbers, structures of `struct`, and tensors or None for the kernel's arrays, see `array`.
        block: threads per block, see `lanes_on`. together: a block for each index of `dim`, as of `wp.launch_tiled`.
    """
    device = next(x.device for x in arguments if isinstance(x, Tensor))
    if device.type == "cuda" and _kept.stream is None:
        with on_stream(device):
            launch(kernel, dim, arguments, block=block, together=together)
        return
    block = lanes_on(device, block)
    size = (*dim, block) if together else tuple(dim)
    key = kernel, device, block
    kept = _kept.launches.get(key)
    if kept is None:
        kept = _kept.launches[key] = _Launch(kernel, device, block)
    if 0 in size:
        return
    kept.prepare(size, arguments).launch(_kept.stream)
    if (recording := running()) is not None:
        recording.launched(arguments)


class _Launch:
    """Launches of a kernel, on a device and with a number of threads per block."""

    def __init__(self, kernel: Any, device: torch.device, block: int) -> None:
        import warp as wp

        wp.init()
        self.command = wp.Launch(kernel, wp.device_from_torch(device), block_dim=block)
        self.on_cuda = device.type == "cuda"
        self.size: tuple[int, ...] = ()
        self.kinds = [argument.type for argument in kernel.adj.args]
        # For each argument that is an array: by type, shape and strides, its description, of which only the address changes.
        self.arrays: list[dict[Any, Any] | None] = [{} if wp.types.is_array(kind) else None for kind in self.kinds]

    def prepare(self, size: tuple[int, ...], arguments: Sequence[Any]) -> Any:
        command = self.command
        params = command.params  # the bounds, and the arguments
        if size != self.size:
            self.size, command.bounds = size, type(command.bounds)(size)  # `set_dim` takes as long as the launch
            params[0] = command.bounds
            if self.on_cuda:
                command.params_addr[0] = ctypes.addressof(command.bounds)
        for index, (argument, kind, known) in enumerate(zip(arguments, self.kinds, self.arrays, strict=True), 1):
            if known is None and not isinstance(argument, ctypes.Structure):
                params[index].value = argument
                continue
            if known is None:
                params[index] = argument
            elif argument is None:
                params[index] = _empty_array()
            else:
                layout = argument.dtype, argument.shape, argument.stride()
                if (described := known.get(layout)) is None:
                    if len(known) >= _MOST_SHAPES:
                        known.clear()
                    described = known[layout] = array(argument, kind)
                described.data = argument.data_ptr()
                params[index] = described
            if self.on_cuda:
                command.params_addr[index] = ctypes.addressof(params[index])
        return command


class _Kept(threading.local):
    """A thread's launches, by kernel, device and threads per block, its arrays to be sorted, by length and device, and the stream
    of `on_stream`.
    """

    stream: Any = None

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, torch.device, int], _Launch] = {}
        self.sorts: dict[tuple[int, torch.device], tuple[Any, ...]] = {}


_kept = _Kept()
_sorting: Final = threading.Lock()
_MOST_SHAPES: Final = 256  # the number of Gaussians, and so the lengths, change in a long training


def sort_pairs(keys: Tensor, values: Tensor, count: int, bits: int) -> tuple[Tensor, Tensor]:
    """The first `count` keys and values in a stable order by key, sorted in a scope of `on_stream`; both tensors have twice that
    length, for scratch.

    Does the same as `wp.utils.radix_sort_pairs`, but `wp.from_torch` would take longer than the sort: Warp's arrays are cached by
    length, and only their addresses change.
    """
    if not count:
        return keys[:0], values[:0]
    import warp as wp

    key = len(keys), keys.device
    arrays = _kept.sorts.get(key)
    if arrays is None:
        if len(_kept.sorts) >= _MOST_SHAPES:
            _kept.sorts.clear()
        device = wp.device_from_torch(keys.device)
        arrays = _kept.sorts[key] = tuple(
            wp.array(ptr=x.data_ptr(), shape=len(x), dtype=wp.int32, device=device) for x in (keys, values)
        )
    arrays[0].ptr, arrays[1].ptr = keys.data_ptr(), values.data_ptr()
    # Warp sorts on its current stream, which is that of all threads.
    with _sorting, wp.ScopedStream(_kept.stream, sync_enter=False):
        wp.utils.radix_sort_pairs(*arrays, count, end_bit=bits)
    if (recording := running()) is not None:
        recording.launched((keys, values))
    return keys[:count], values[:count]


def array(tensor: Tensor | None, kind: Any) -> Any:
    """A tensor as a kernel's array of type `kind`, without a copy; the caller keeps it alive. None becomes an empty array.

    The tensor may have more dimensions than the array: those of the array's vectors or matrices, or one with the numbers of a
    structure, and before them some that the array's last dimension goes through.

    Raises:
        TypeError: its numbers have another type than the array's.
        ValueError: its strides do not fit the array.
    """
    if tensor is None:
        return _empty_array()
    layout = _layout(kind.dtype, kind.ndim, tensor.dtype, tensor.shape, tensor.stride())
    described = type(layout).from_buffer_copy(layout)
    described.data = tensor.data_ptr()
    return described


@lru_cache(maxsize=4096)  # a training's are those of the iteration before until the number of Gaussians changes
def _layout(of: Any, n: int, dtype: torch.dtype, shape: Sequence[int], strides: Sequence[int]) -> Any:
    """A tensor as an array of n dimensions `of` a type of Warp, without its address."""
    if not (is_struct := hasattr(of, "ctype")):
        _require_numbers(dtype, of)
    inner = (ctypes.sizeof(of.ctype) // dtype.itemsize,) if is_struct else getattr(of, "_shape_", ())
    outer, dense = len(shape) - len(inner), tuple(math.prod(inner[k + 1 :]) for k in range(len(inner)))
    last = [
        (length, step) for length, step in zip(shape[n - 1 : outer], strides[n - 1 : outer], strict=True) if length != 1
    ]
    joined = strides[outer:] == dense and all(step == length * finer for (_, step), (length, finer) in pairwise(last))
    if not joined and 0 not in shape:
        raise ValueError(
            f"a tensor of shape {tuple(shape)} with strides {strides} is no array of {n} dimensions; copy it."
        )
    lengths = *shape[: n - 1], math.prod(length for length, _ in last)
    steps = *strides[: n - 1], last[-1][1] if last else math.prod(inner)
    return type(_empty_array())(0, 0, n, lengths, [step * dtype.itemsize for step in steps])


def _require_numbers(dtype: torch.dtype, kind: Any) -> None:
    import warp as wp

    read, given = getattr(kind, "_wp_scalar_type_", kind), wp.dtype_from_torch(dtype)  # of a vector, of a number
    if given is not read:
        raise TypeError(f"a kernel reads numbers of type {read.__name__}, got {given.__name__}: cast the tensor.")


def struct(kind: Any, /, **fields: Any) -> Any:
    """A Warp structure as a kernel argument, of numbers, structures, and tensors for its arrays; what is None or not given is
    empty, or 0.
    """
    tensors = {name: array(x, kind.vars[name].type) for name, x in fields.items() if isinstance(x, Tensor)}
    return kind.ctype(**{name: x for name, x in fields.items() if x is not None} | tensors)


def on_device(structure: Any, device: torch.device) -> Tensor:
    """A structure without arrays as an array of one, in a tensor of its bytes."""
    return sent(torch.frombuffer(bytearray(structure), dtype=torch.uint8)[None], device)


@cache
def _empty_array() -> Any:
    """Warp's structure of an array: (address, address of the gradient, dimensions, shape, strides in bytes)."""
    import warp as wp

    return type(wp.from_torch(torch.empty(1, device="cpu"), return_ctype=True))()


@contextmanager
def on_stream(device: torch.device) -> Iterator[None]:
    """A scope in which this thread launches on torch's current stream, which is looked up once."""
    outer, current = _kept.stream, None if device.type == "cpu" else torch.cuda.current_stream(device)
    _kept.stream = None if current is None else warp_stream(current)
    try:
        yield
    finally:
        _kept.stream = outer
