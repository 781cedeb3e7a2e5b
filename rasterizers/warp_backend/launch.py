"""Torch's tensors as arguments of Warp's kernels, and torch's stream as Warp's: for whatever runs on Warp.

To be imported once `rasterizers.warp_backend.require` has found Warp.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor


def array(tensor: Tensor | None, dtype: Any = None) -> Any:
    """A tensor as a kernel's argument, without a copy; the caller keeps it alive. None is an array of nothing."""
    return None if tensor is None else wp.from_torch(tensor, dtype, return_ctype=True)


def on_stream(device: torch.device) -> AbstractContextManager[Any]:
    """Warp's work goes where torch's goes."""
    wp.init()
    if device.type == "cpu":
        return nullcontext()
    scope: AbstractContextManager[Any] = wp.ScopedStream(_stream(torch.cuda.current_stream(device)), sync_enter=False)
    return scope


@cache
def _stream(stream: torch.cuda.Stream) -> Any:
    """Torch's stream as Warp knows it; kept, for Warp keeps the scratch of its sort with it."""
    return wp.stream_from_torch(stream)
