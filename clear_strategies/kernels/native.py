"""The compiled module of this package, built from `src/`, and whether there is one."""

from __future__ import annotations

from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import BackendUnavailable
from rasterizers.native import empty, load_kernels


def available() -> bool:
    """Return True if the kernels were compiled and run on this processor."""
    try:
        module()
    except BackendUnavailable:
        return False
    return True


def module() -> ModuleType:
    """The compiled module for this processor's instruction set; raises BackendUnavailable if there is none."""
    return load_kernels("clear_strategies.kernels")


def times(a: Float[Tensor, "N G"], b: Tensor) -> Float[Tensor, "N G"]:
    """A · b, with a's type and layout; in recycled memory if there are compiled kernels."""
    if a.device.type != "cpu" or not available():
        return a * b
    out = empty(a.shape, a.dtype) if a.is_contiguous() else empty(a.shape[::-1], a.dtype).T
    return torch.mul(a, b, out=out)


def runs(x: Tensor) -> bool:
    """Return True if the kernels take this tensor: float32 in the CPU's memory."""
    return x.device.type == "cpu" and x.dtype == torch.float32 and available()
