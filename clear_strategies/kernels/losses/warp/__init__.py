"""The losses of `reference` in NVIDIA Warp, for float32 images [H, W, 3] on CUDA; the same kernels run on a CPU, to check them.

This module does not import Warp until a loss is computed. Losses stay on the device, and the host does not wait for it. All
work runs on torch's current stream in memory of torch's allocator. Results have the same bits in every run.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType

from rasterizers.warp_runtime import require_warp


@cache
def require(device: str) -> None:
    """Raise a BackendUnavailable, whose message says why, unless Warp runs on this device."""
    require_warp("kernels=warp", device, "kernels=torch runs here")


def loaded(device: str) -> ModuleType:
    """The launchers of the kernels on this device, as in `losses.cpp`; a BackendUnavailable where Warp does not run."""
    require(device)
    from clear_strategies.kernels.losses.warp import launches

    return launches
