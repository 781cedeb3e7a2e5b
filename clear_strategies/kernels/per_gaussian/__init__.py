"""What an iteration computes for each Gaussian between its renderings and its step, on CUDA: a few kernels of Warp, where torch
launches one for each operation.

`GaussianField`, `P2G`, `Conductor.scores` and `Density` say in torch what they compute; tests/kernels/test_per_gaussian.py
compares. On a CPU they compute it themselves.
"""

from __future__ import annotations

from types import ModuleType
from typing import Final

import torch
from torch import Tensor

from clear_strategies.kernels import losses

DEVICES: Final = {"cuda"}
"""Where the kernels are used; tests add the CPU."""


def for_tensors(*tensors: Tensor | None) -> ModuleType | None:
    """The kernels, where they take these tensors: float32 on CUDA, with Warp installed."""
    for x in tensors:
        if x is not None and (x.device.type not in DEVICES or x.dtype != torch.float32):
            return None
    device = next(x.device.type for x in tensors if x is not None)
    if not losses.warp.available(device):
        return None
    from clear_strategies.kernels.per_gaussian import warp

    return warp
