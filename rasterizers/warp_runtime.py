"""What the Warp packages share: a check that Warp runs here, torch tensors as kernel arguments, and torch's stream.

Used by `rasterizers.warp_backend` and by the Warp kernels in `clear_strategies.kernels`. Imports Warp only when called.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache, lru_cache
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


def array(tensor: Tensor | None, dtype: Any = None) -> Any:
    """The tensor as a kernel argument, without a copy; the caller keeps it alive. None becomes an empty array.

    The same as `wp.from_torch(tensor, dtype, return_ctype=True)`, without its checks, in a third of the time: on CUDA that is
    a sixth of an iteration.
    """
    if tensor is None:
        return None
    inner = len(getattr(dtype, "_shape_", ()))  # the dimensions of a vector or a matrix are not the array's
    size, shape = tensor.element_size(), tensor.shape
    return _descriptor()(tensor.data_ptr(), 0, len(shape) - inner, shape, [stride * size for stride in tensor.stride()])


@cache
def _descriptor() -> Any:
    """Warp's structure of an array: (address, address of the gradient, dimensions, shape, strides in bytes)."""
    import warp as wp

    return type(wp.from_torch(torch.empty(1, device="cpu"), return_ctype=True))


@lru_cache(maxsize=4096)
def structure(owner: str, kind: Any, fields: tuple[tuple[str, int, int], ...], device: str) -> Any:
    """A Warp structure of float32 arrays given by (name, address, length), cached because describing a tensor to Warp takes
    longer than launching a kernel. `owner` keeps structures over the same addresses apart. A launch copies the structure.
    """
    import warp as wp

    out = kind()
    for name, address, length in fields:
        setattr(out, name, wp.array(ptr=address, dtype=wp.float32, shape=(length,), device=device))
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
