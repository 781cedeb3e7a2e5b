"""What the Warp packages share: a check that Warp runs here, torch tensors as kernel arguments, launches, and
torch's stream.

Used by `rasterizers.warp_backend` and by the Warp kernels in `clear_strategies.kernels`. Imports Warp only when called.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any

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
    for index, argument in enumerate(arguments):
        command.set_param_at_index_from_ctype(index, argument)
    command.launch()


class _Recorded(threading.local):
    """A thread's launches and the sizes that they have, by kernel, device and threads per block."""

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, torch.device, int], list[Any]] = {}


_recorded = _Recorded()


def array(tensor: Tensor | None, dtype: Any = None) -> Any:
    """The tensor as a kernel argument, without a copy; the caller keeps it alive. None becomes an empty array.

    The same as `wp.from_torch(tensor, dtype, return_ctype=True)`, without its checks, in a third of the time.
    """
    if tensor is None:
        return _descriptor()()
    inner = len(getattr(dtype, "_shape_", ()))  # the dimensions of a vector or a matrix are not the array's
    size, shape = tensor.element_size(), tensor.shape
    return _descriptor()(tensor.data_ptr(), 0, len(shape) - inner, shape, [stride * size for stride in tensor.stride()])


@cache
def _descriptor() -> Any:
    """Warp's structure of an array: (address, address of the gradient, dimensions, shape, strides in bytes)."""
    import warp as wp

    return type(wp.from_torch(torch.empty(1, device="cpu"), return_ctype=True))


def struct(kind: Any, rows: Mapping[str, Tensor | None], **values: Any) -> Any:
    """A Warp structure as a kernel argument: `rows` as flat arrays, numbers, structures. What is not given is empty, or 0."""
    out = kind.ctype()
    for name, tensor in rows.items():
        if tensor is not None:
            setattr(out, name, array(tensor.detach().view(-1)))
    for name, value in values.items():
        setattr(out, name, value)
    return out


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
