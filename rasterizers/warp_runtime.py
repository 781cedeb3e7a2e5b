"""What the Warp packages share: a check that Warp runs here, torch tensors as kernel arguments, launches, and
torch's stream.

Used by `rasterizers.warp_backend` and by the Warp kernels in `clear_strategies.kernels`. Imports Warp only when called.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
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

    As `wp.launch`, in a third of the host's time, which on CUDA exceeds the kernels': what does not change is recorded once.

    Args:
        arguments: from `array` and `struct`, and numbers.
        block: threads per block. together: a block for each index of `dim`, as of `wp.launch_tiled`.
    """
    import warp as wp

    size = (*dim, block) if together else tuple(dim)
    if 0 in size:
        return
    key = kernel, device, block
    recorded = _recorded.launches.get(key)
    if recorded is None:
        recorded = _recorded.launches[key] = [wp.Launch(kernel, wp.device_from_torch(device), block_dim=block), ()]
    command, last = recorded
    if size != last:
        command.set_dim(size)
        recorded[1] = size
    params, addresses = (
        command.params,
        command.params_addr,
    )  # of the kernel's size and arguments; addresses on CUDA alone
    for index, argument in enumerate(arguments, 1):
        if isinstance(argument, ctypes.Structure):
            params[index] = argument
            if addresses:
                addresses[index] = ctypes.addressof(argument)
        else:
            params[index].value = argument
    command.launch()


class _Recorded(threading.local):
    """A thread's launches and the sizes that they have, by kernel, device and threads per block."""

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, torch.device, int], list[Any]] = {}


_recorded = _Recorded()


def array(tensor: Tensor | None, dtype: Any = None) -> Any:
    """The tensor as a kernel argument, without a copy; the caller keeps it alive. None becomes an empty array.

    The same as `wp.from_torch(tensor, dtype, return_ctype=True)`, without its checks, in a fifth of the time.
    """
    if tensor is None:
        return _empty_array()
    return type(_empty_array()).from_buffer_copy(
        _packed(tensor.data_ptr(), tensor.shape, tensor.stride(), tensor.dtype, dtype)
    )


def struct(kind: Any, rows: Mapping[str, Tensor | None], **values: Any) -> Any:
    """A Warp structure as a kernel argument: `rows` as flat arrays, numbers, structures. What is not given is empty, or 0."""
    ctype, places = _places(kind)
    memory = bytearray(ctypes.sizeof(ctype))
    for name, tensor in rows.items():
        if tensor is not None:
            start, end, _ = places[name]
            flat = tensor.detach().view(-1)
            memory[start:end] = _packed(flat.data_ptr(), flat.shape, (1,), flat.dtype, None)
    for name, value in values.items():
        start, end, number = places[name]
        if number is None:
            memory[start:end] = value
        else:
            number.pack_into(memory, start, value)
    return ctype.from_buffer(memory)


_layouts: dict[tuple[Any, ...], bytes] = {}  # of arrays: what follows their addresses, by shape and type
_MOST_LAYOUTS: Final = 4096  # the number of Gaussians, and so the shapes, change in a long training
_ADDRESSES: Final = Struct("=QQ")  # of an array and of its gradient


def _packed(address: int, shape: tuple[int, ...], strides: tuple[int, ...], dtype: torch.dtype, inner: Any) -> bytes:
    """The memory of Warp's structure of an array.

    Args:
        strides: in numbers. inner: a type of vectors or matrices, whose dimensions are not the array's.
    """
    key = shape, strides, dtype, inner
    layout = _layouts.get(key)
    if layout is None:
        if len(_layouts) >= _MOST_LAYOUTS:
            _layouts.clear()
        n = len(shape) - len(getattr(inner, "_shape_", ()))
        described = type(_empty_array())(0, 0, n, shape, [stride * dtype.itemsize for stride in strides])
        layout = _layouts[key] = bytes(described)[_ADDRESSES.size :]
    return _ADDRESSES.pack(address, 0) + layout


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
    import warp as wp

    wp.init()
    if device.type == "cpu":
        return nullcontext()
    scope: AbstractContextManager[Any] = wp.ScopedStream(_stream(torch.cuda.current_stream(device)), sync_enter=False)
    return scope


@cache
def _stream(stream: torch.cuda.Stream) -> Any:
    """Torch's stream as a Warp stream. Cached, because Warp keeps the scratch memory of its sort with the stream."""
    import warp as wp

    return wp.stream_from_torch(stream)
