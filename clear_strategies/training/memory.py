"""The memory of training: what the process holds is measured, what training adds is estimated, and what cannot fit is refused."""

from __future__ import annotations

import ctypes
import gc
import logging
import sys
from typing import Final

import psutil
import torch

from clear_strategies.errors import SettingError
from clear_strategies.training.state import TrainState
from rasterizers import native

_log = logging.getLogger(__name__)

_COPIES: Final = 5  # of a Gaussian's parameters: themselves, Adam's two moments, a change of structure, an anchor
_GAUSSIAN: Final = 1536  # bytes of an iteration per Gaussian: projection, gradients, the rasterizer's lists
_PIXEL: Final = 168  # bytes of an iteration per pixel of HR: the render, its cotangents, what the losses hold


def require(state: TrainState, limit: int | None) -> str:
    """Refuse a run whose first Gaussians do not fit into `limit` MiB (None: what is free on this machine), and warn where it
    cannot grow as far as it may; returns a line for the plan.
    """
    cuda, n, most = state.device.type == "cuda", len(state.field), state.density.cap
    now = torch.cuda.memory_allocated(state.device) if cuda else psutil.Process().memory_info().rss
    each = _COPIES * sum(x.nbytes for x in state.field.raw().values()) // n + _GAUSSIAN
    fixed = now + _PIXEL * max(view.hr.image[..., 0].numel() for view in state.views)
    start, grown = ((fixed + each * count) >> 20 for count in (n, most or n))
    free = torch.cuda.mem_get_info()[0] if cuda else psutil.virtual_memory().available
    allowed = limit if limit is not None else (free + now) >> 20
    source = "is free on this machine" if limit is None else "fit.memory allows"
    if start > allowed:
        raise SettingError(
            f"fit.memory: {n:,} Gaussians need about {start} MiB, and {allowed} MiB {source}. Raise data.views.shrink, "
            "lower fit.max_degree or data.cloud.max_points, or raise fit.memory."
        )
    if grown > allowed:
        need = f"{most} Gaussians, the most that there may be, need about {grown} MiB"
        _log.warning("%s, and %d MiB %s.", need, allowed, source)
    return f"about {start} MiB at the start, {each / 1024:.1f} KiB for each further Gaussian"


def release() -> None:
    """Give the system what has been freed, which the kernels and the C library keep: after training up to a GiB."""
    gc.collect()
    native.release()
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:  # glibc
        trim(0)
