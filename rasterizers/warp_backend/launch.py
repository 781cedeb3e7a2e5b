"""For whatever runs on Warp: whether it is here, torch's tensors as its kernels' arguments, and torch's stream as its own."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any

import torch
from torch import Tensor

from rasterizers.interface import BackendUnavailable


def require(what: str, device: str, otherwise: str) -> None:
    """Make sure of Warp before `what` imports it, and keep it off stdout.

    Args:
        device: "cuda" or "cpu", where `what` is to run.
        otherwise: what runs here where CUDA is not to be had.

    Raises:
        BackendUnavailable: Warp is not installed, or finds no CUDA device.
    """
    try:
        import warp as wp
    except ImportError as error:
        raise BackendUnavailable(
            f"{what} needs NVIDIA Warp, which is not installed ({error}); pip install 'clear-strategies[warp]'."
        ) from error
    # Its greeting, and a line for every compilation, would go to stdout, which is the caller's.
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
    """A tensor as a kernel's argument, without a copy; the caller keeps it alive. None is an array of nothing."""
    import warp as wp

    return None if tensor is None else wp.from_torch(tensor, dtype, return_ctype=True)


def on_stream(device: torch.device) -> AbstractContextManager[Any]:
    """Warp's work goes where torch's goes."""
    import warp as wp

    wp.init()
    if device.type == "cpu":
        return nullcontext()
    scope: AbstractContextManager[Any] = wp.ScopedStream(_stream(torch.cuda.current_stream(device)), sync_enter=False)
    return scope


@cache
def _stream(stream: torch.cuda.Stream) -> Any:
    """Torch's stream as Warp knows it; kept, for Warp keeps the scratch of its sort with it."""
    import warp as wp

    return wp.stream_from_torch(stream)
