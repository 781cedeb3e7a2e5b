"""The merge in one pass over the Gaussians, for trainers that have their own optimizer: gradients in, the merged gradient out.

    out = before + scale (g_LR + λ_HR ĝ_HR + stiffness (θ - θ^a))                                    Eq. 7, 8, 16

`merging.conductor.Conductor.merge` and `strategies.gco.GCO.correct_in_torch` specify it. `cpp` runs on the CPU, `warp` on
CUDA; both share the source of the decisions with the per-Gaussian step of this package's trainer.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import torch
from torch import Tensor
from torch.utils.dlpack import from_dlpack

from clear_strategies.kernels import native
from clear_strategies.kernels.merge.interface import WIDEST, Colour, Merge, Merged, Rows
from rasterizers.interface import BackendUnavailable
from rasterizers.native import load_kernels
from rasterizers.warp_runtime import require_warp

__all__ = ["Colour", "Merge", "Merged", "Rows", "compiled", "empty_like"]


def compiled(tensors: Iterable[Tensor]) -> Merge | None:
    """The compiled pass for gradients like these; None where there is none: another type or device, wider rows, or no kernels."""
    gradients = list(tensors)
    first = gradients[0]
    if any(g.dtype != torch.float32 or g.device != first.device or g.shape[1:].numel() > WIDEST for g in gradients):
        return None
    return _for_device(first.device.type)


def empty_like(p: Tensor) -> Tensor:
    """Contiguous float32 of this shape, not initialized; on a CPU in memory that the last gradient has left."""
    if p.device.type == "cpu":
        return from_dlpack(load_kernels("rasterizers.cpp").Frame.empty(p.shape))
    return torch.empty_like(p, dtype=torch.float32, memory_format=torch.contiguous_format)


@cache
def _for_device(device: str) -> Merge | None:
    try:
        if device == "cpu":
            native.module()
            from clear_strategies.kernels.merge import cpp

            return cpp.merge
        if device == "cuda":
            require_warp("the compiled merge", device, "torch merges in its place")
            from clear_strategies.kernels.merge import warp

            return warp.merge
    except BackendUnavailable:
        pass
    return None
