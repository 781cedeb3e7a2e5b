"""A rasterizer in NVIDIA Warp: Python functions compiled at first use, one source for CUDA and for the CPU, in float32.

The stages are those of `rasterizers.reference`, and so are their names: project, bin, blend, and back. `frame` runs them;
the other files hold what runs on the device, adjoints written by hand. This file knows whether Warp can run here.

Deterministic: every sum has one order, and there are no floating-point atomics.
"""

from __future__ import annotations

from typing import Any

import torch

from rasterizers.interface import BackendUnavailable, Rasterizer


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
