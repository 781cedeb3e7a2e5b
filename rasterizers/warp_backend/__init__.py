"""A rasterizer in NVIDIA Warp: Python functions compiled at first use, one source for CUDA and for the CPU, in float32.

The stages are those of `rasterizers.reference`, and so are their names: project, bin, blend, and back. `frame` runs them;
`launch` knows Warp and whether it is here; the other files hold what runs on the device, adjoints written by hand.

Deterministic: every sum has one order, and there are no floating-point atomics.
"""

from __future__ import annotations

from typing import Any

import torch

from rasterizers.interface import Rasterizer
from rasterizers.warp_backend.launch import require


def create(device: str | None = None, **settings: Any) -> Rasterizer:
    """The backend called "warp"; `settings` are the fields of `frame.WarpRasterizer`.

    Args:
        device: "cuda" or "cpu", where the splats' tensors lie; None: "cuda" where torch finds it.

    Raises:
        BackendUnavailable: Warp is not installed, or CUDA was asked for and is not to be had.
        ValueError: no such device, or a setting that it does not have, or that is out of range.
    """
    if device not in (None, "cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {device!r}.")
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
    require("the warp rasterizer", device, "device=cpu runs here, slowly")
    from rasterizers.checks import build
    from rasterizers.warp_backend.frame import WarpRasterizer

    return build(WarpRasterizer, {**settings, "device": device})
