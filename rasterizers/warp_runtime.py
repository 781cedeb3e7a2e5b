"""What the Warp packages share: a check that Warp runs here, torch tensors as kernel arguments, launches, and
torch's stream.

Used by `rasterizers.warp_backend` and by the Warp kernels in `clear_strategies.kernels`. Imports Warp only when called.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache, lru_cache
from itertools import pairwise
from struct import Struct
from typing import Any, Final

import torch
from torch import Tensor

from rasterizers.interface import BackendUnavailable


def require_warp(what: str, device: str, otherwise: str) -> None:
    """Check that Warp can run `what`, before it is imported, and silence Warp's output on stdout.

    Args:
        what: names the caller in the error message.
        device: "cuda" or "cpu".
        otherwise: says in the error message what runs without CUDA.

    Raises:
        BackendUnavailable: Warp is not installed, or there is no CUDA device.
    """
    try:
        import warp as wp
    except ImportError as error:
        raise BackendUnavailable(
            f"{what} needs NVIDIA Warp, which is not installed ({error}); pip install 'clear-strategies[warp]'."
        ) from error
    # Warp would print a greeting and a line per compilation to stdout, which belongs to the application.
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    if device == "cuda" and not torch.cuda.is_available():
        raise BackendUnavailable(
            f"{what} cannot run on CUDA: torch finds no CUDA device. Install NVIDIA's driver and a torch built for CUDA; "
            f"{otherwise}."
        )
    if device == "cuda" and wp.get_cuda_device_count() == 0:
        raise BackendUnavailable(
            f"{what} cannot run on CUDA: torch finds a CUDA device, Warp does not. Update NVIDIA's driver or warp-lang; "
            f"{otherwise}."
        )


def launch(
    kernel: Any, dim: Sequence[int], arguments: Sequence[Any], device: torch.device, *, block: int = 256, together: bool = False
) -> None:  # fmt: skip
    """Launch a kernel with a thread for each index of `dim`, in a scope of `on_stream`.

    As `wp.launch`, in a fifth of the host's time, which on CUDA exceeds the kernels': what does not change is recorded once.

    Args:
        arguments: numbers, structures of `struct`, and tensors or None for the kernel's arrays, see `array`.
        block: threads per block. together: a block for each index of `dim`, as of `wp.launch_tiled`.
    """
    size = (*dim, block) if together else tuple(dim)
    if 0 in size:
        return
    key = kernel, device, block
    recorded = _recorded.launches.get(key)
    if recorded is None:
        recorded = _recorded.launches[key] = _Launch(kernel, device, block)
    recorded(size, arguments)


class _Launch:
    """A launch whose size and arguments are written anew where they change."""

    def __init__(self, kernel: Any, device: torch.device, block: int) -> None:
        import warp as wp

        wp.init()
        self.command = wp.Launch(kernel, wp.device_from_torch(device), block_dim=block)
        self.size: tuple[int, ...] = ()
        kinds = [argument.type for argument in kernel.adj.args]
        self.arrays = [_Described(kind) if wp.types.is_array(kind) else None for kind in kinds]

    def __call__(self, size: tuple[int, ...], arguments: Sequence[Any]) -> None:
        command = self.command
        if size != self.size:
            command.set_dim(size)
            self.size = size
        # `params`: the size and the arguments; their addresses on CUDA alone.
        params, addresses = command.params, command.params_addr
        for index, (argument, array_of) in enumerate(zip(arguments, self.arrays, strict=True), 1):
            if array_of is not None:
                argument = array_of(argument)  # noqa: PLW2901
            elif not isinstance(argument, ctypes.Structure):
                params[index].value = argument
                continue
            params[index] = argument
            if addresses:
                addresses[index] = ctypes.addressof(argument)
        command.launch()


class _Described:
    """Tensors as an array argument of a launch. The structure of each shape is kept, and receives the tensor's address; it holds
    until the next tensor of that shape.
    """

    def __init__(self, kind: Any) -> None:
        self.kind = kind
        self.known: dict[tuple[tuple[int, ...], tuple[int, ...]], Any] = {}

    def __call__(self, tensor: Tensor | None) -> Any:
        if tensor is None:
            return _empty_array()
        layout = tensor.shape, tensor.stride()
        known = self.known.get(layout)
        if known is None:
            if len(self.known) >= _MOST_SHAPES:
                self.known.clear()
            known = self.known[layout] = array(tensor, self.kind)
        else:
            known.data = tensor.data_ptr()
        return known


class _Recorded(threading.local):
    """A thread's launches, by kernel, device and threads per block."""

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, torch.device, int], _Launch] = {}


_recorded = _Recorded()
_MOST_SHAPES: Final = 256  # the number of Gaussians, and so the shapes, change in a long training
_MOST_STRUCTURES: Final = 4096
_structures: dict[tuple[Any, ...], Any] = {}
_ADDRESSES: Final = Struct("=QQ")  # of an array and of its gradient


def array(tensor: Tensor | None, kind: Any) -> Any:
    """A tensor as a kernel's array of type `kind`, without a copy; the caller keeps it alive. None becomes an empty array.

    The tensor may have more dimensions than the array: those of the array's vectors or matrices, and before them some that the
    array's last dimension goes through.
    """
    if tensor is None:
        return _empty_array()
    inner = getattr(kind.dtype, "_shape_", ())
    layout = _layout(kind.ndim, inner, tensor.shape, tensor.stride(), tensor.element_size())
    return type(_empty_array()).from_buffer_copy(_ADDRESSES.pack(tensor.data_ptr(), 0) + layout)


def struct(kind: Any, rows: Mapping[str, Tensor | None], **values: Any) -> Any:
    """A Warp structure as a kernel argument: `rows` as arrays, numbers, bytes of structures. What is not given is empty, or 0.

    Equal structures are one object, which is made once: most of a training's iteration are those of the iteration before.
    """
    given = {name: x for name, x in rows.items() if x is not None}
    key = kind, (*values.items(),), *[(name, x.data_ptr(), x.shape, x.stride()) for name, x in given.items()]
    known = _structures.get(key)
    if known is None:
        if len(_structures) >= _MOST_STRUCTURES:
            _structures.clear()
        known = _structures[key] = _made(kind, given, values)
    return known


def _made(kind: Any, rows: Mapping[str, Tensor], values: Mapping[str, Any]) -> Any:
    """The structure of `struct`."""
    ctype, places = _places(kind)
    memory = bytearray(ctypes.sizeof(ctype))
    for name, tensor in rows.items():
        start, end, _ = places[name]
        memory[start:end] = array(tensor, kind.vars[name].type)
    for name, value in values.items():
        start, end, number = places[name]
        if number is None:
            memory[start:end] = value
        else:
            number.pack_into(memory, start, value)
    return ctype.from_buffer(memory)


@lru_cache(maxsize=4096)
def _layout(n: int, inner: tuple[int, ...], shape: tuple[int, ...], strides: tuple[int, ...], size: int) -> bytes:
    """What follows the addresses in Warp's structure of an array of n dimensions.

    Args:
        inner: dimensions of the array's vectors or matrices. size: of a number, bytes.
    """
    outer, dense = len(shape) - len(inner), tuple(math.prod(inner[k + 1 :]) for k in range(len(inner)))
    last = [
        (length, step) for length, step in zip(shape[n - 1 : outer], strides[n - 1 : outer], strict=True) if length != 1
    ]
    joined = 0 in shape or all(step == length * finer for (_, step), (length, finer) in pairwise(last))
    if not joined or tuple(strides[outer:]) != dense:
        raise ValueError(
            f"a tensor of shape {tuple(shape)} with strides {strides} is no array of {n} dimensions; copy it."
        )
    lengths = *shape[: n - 1], math.prod(length for length, _ in last)
    steps = *strides[: n - 1], last[-1][1] if last else math.prod(inner)
    described = type(_empty_array())(0, 0, n, lengths, [step * size for step in steps])
    return bytes(described)[_ADDRESSES.size :]


@cache
def _empty_array() -> Any:
    """Warp's structure of an array: (address, address of the gradient, dimensions, shape, strides in bytes)."""
    import warp as wp

    return type(wp.from_torch(torch.empty(1, device="cpu"), return_ctype=True))()


@cache
def _places(kind: Any) -> tuple[Any, Mapping[str, tuple[int, int, Struct | None]]]:
    """A Warp structure's type, and where each field begins and ends in it; with the format of a number, None for another."""
    ctype, places = kind.ctype, {}
    for name, field in ctype._fields_:
        at = getattr(ctype, name)
        number = Struct(f"={field._type_}") if issubclass(field, ctypes._SimpleCData) else None
        places[name] = at.offset, at.offset + at.size, number
    return ctype, places


def on_stream(device: torch.device) -> AbstractContextManager[Any]:
    """A scope in which Warp launches on torch's current stream."""
    if device.type == "cpu":
        return nullcontext()
    import warp as wp

    wp.init()
    scope: AbstractContextManager[Any] = wp.ScopedStream(_stream(torch.cuda.current_stream(device)), sync_enter=False)
    return scope


@cache
def _stream(stream: torch.cuda.Stream) -> Any:
    """Torch's stream as a Warp stream. Cached, because Warp keeps the scratch memory of its sort with the stream."""
    import warp as wp

    return wp.stream_from_torch(stream)
