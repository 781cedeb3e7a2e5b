"""Which implementation of this package's functions runs on a device, and the module compiled from `src/`."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Literal

import torch
from torch import Tensor

from rasterizers.interface import BackendUnavailable
from rasterizers.native import empty_for, load_kernels
from rasterizers.warp_runtime import runs_warp


def fastest(device: torch.device) -> Literal["cpp", "warp", "torch"]:
    """What computes float32 on this device: C++ on a CPU, Warp on CUDA, torch where these do not run."""
    if device.type == "cpu" and available():
        return "cpp"
    return "warp" if device.type == "cuda" and runs_warp() else "torch"


def implementation(package: str, *tensors: Tensor) -> ModuleType:
    """The module of a package that computes these tensors: `cpp` or `warp` for float32 on one device, else `reference` in torch.
    Tensors of whole numbers and masks among them may have any type.
    """
    device = tensors[0].device
    alike = all(x.device == device and (x.dtype == torch.float32 or not x.is_floating_point()) for x in tensors)
    name = fastest(device) if alike else "torch"
    return import_module(f"{package}.{'reference' if name == 'torch' else name}")


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


def times(a: Tensor, b: Tensor) -> Tensor:
    """A · b, with a's type and layout, [N, G] by rows or columns; in recycled memory if there are compiled kernels."""
    return torch.mul(a, b, out=empty_for(a) if a.is_contiguous() else empty_for(a.T).T)


def runs(x: Tensor) -> bool:
    """Return True if the kernels take this tensor: float32 in the CPU's memory."""
    return x.device.type == "cpu" and x.dtype == torch.float32 and available()
