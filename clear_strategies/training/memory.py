"""The peak of memory that training needs, predicted before the first iteration, and the budget it is compared with.

What the process holds already, the photos and what loading them took, is measured. What training adds is counted per Gaussian
and per pixel, in `Needs` alone:

    peak(n) = max(peak so far, memory now + what n Gaussians add)

A rasterizer bounds its own lists (`rasterizer.memory`, MiB) and draws in parts beyond that.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import sys
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch

from clear_strategies.errors import SettingError
from clear_strategies.training.state import TrainState
from rasterizers.interface import CountsLists, Rasterizer

_log = logging.getLogger(__name__)

_FLOAT: Final = 4  # bytes
_MIB: Final = 1 << 20
_MOST: Final = 1 << 40  # Gaussians
_KEPT: Final = 20 * _MIB  # what training frees and the C library keeps: 18 to 29 MiB on three scenes, with one arena 7
# Floats per Gaussian, beside the parameters: what one iteration holds at once.
# Activation: scales twice, their squares, sigmoid, coefficient, factor, opacities.
_ACTIVATION: Final = 3 + 3 + 3 + 3 + 1 + 1 + 1 + 2
# Projection: slopes of the colour, depth in float64, two orders, the drawn ones, their ranges.
_PROJECTION: Final = 16 + 2 + 2 + 1 + 4
_GRID: Final = 16 + 2 + 2 + 1 + 1  # ellipse, range of bins, centre, flags, first pair; once per scale
_GRADIENT: Final = 3 + 4 + 3 + 1 + 2 + 3  # of one cotangent
_COTANGENTS: Final = 3  # L_LR, L_base, L_HF
_EVIDENCE: Final = 8  # q, a, w, m, the scores and their sums
# Floats per pixel of the largest HR image: the render with alpha and the ends of its blocks, two cotangents and their copy,
# and what the losses hold, or a strategy that compares the SR image with the photo.
_PER_PIXEL: Final = (3 + 1 + 2) + 2 * (2 * 3) + max(4 * 3, 8 * 3)


@dataclass(frozen=True, slots=True)
class Needs:
    """What training takes, in bytes.

    Args:
        now: of the process, or of the device, before the first iteration. reached: the most so far.
        gaussians: their number at the start.
        held: per Gaussian, for the whole run: parameters, moments, statistics, and what strategies keep.
        worked: per Gaussian, while an iteration runs.
        lists: per Gaussian, of the rasterizer; at most `most_lists` in all.
        pixels: of the images of one iteration, and of the coarse SR images of all views.
        kept: by the C library, of what training frees.
        cuda: this is the device's memory, not the process's.
    """

    now: int
    reached: int
    gaussians: int
    held: int
    worked: int
    lists: int
    most_lists: int
    pixels: int
    kept: int = 0
    cuda: bool = False

    def peak(self, gaussians: int) -> int:
        """With this many Gaussians, from the start or by growing to them. Checkpoints are written without copies."""
        grown = max(0, gaussians - self.gaussians) * self.held
        drawn = min(gaussians * self.lists, self.most_lists)
        return max(self.reached, self.now + grown + gaussians * self.worked + drawn + self.pixels + self.kept)

    def fits(self, budget: int) -> int:
        """The most Gaussians whose peak is within the budget, 0 where not even the first are."""
        if self.peak(self.gaussians) > budget:
            return 0
        return bisect_right(range(_MOST), budget, lo=self.gaussians, key=self.peak) - 1


def needs(state: TrainState, rasterizer: Rasterizer) -> Needs:
    """Count for this run; draws nothing."""
    n, raw, cuda = len(state.field), state.field.raw(), state.device.type == "cuda"
    parameters = sum(x.nbytes for x in raw.values()) // n
    statistics = sum(x.nbytes for x in state.density.state_dict().values()) // n
    anchored = sum(raw[name].nbytes for s in state.conductor.strategies for name in s.keeps() if name in raw) // n
    held = 3 * parameters + _FLOAT + statistics + anchored
    # A change of structure copies tensor by tensor, and the images drawn before it still hold the former parameters.
    copied = parameters + max(x.nbytes for x in raw.values()) // n
    basis = 1 + state.field.shN.shape[1]
    scales = 1 + state.conductor.wants_lr
    floats = _ACTIVATION + _PROJECTION + scales * _GRID + _COTANGENTS * _GRADIENT + scales * basis + _EVIDENCE
    view = max(state.views, key=lambda view: view.hr.image.numel())
    lists, most = 0, 0
    if isinstance(rasterizer, CountsLists):
        lists, most = rasterizer.list_bytes(state.field.baked(), view.hr.camera) // n, rasterizer.memory * _MIB
    return Needs(
        now=torch.cuda.memory_allocated(state.device) if cuda else resident(),
        reached=torch.cuda.max_memory_allocated(state.device) if cuda else peak(),
        gaussians=n,
        held=held,
        worked=_FLOAT * floats + copied,
        lists=lists,
        most_lists=most,
        pixels=_FLOAT * _PER_PIXEL * (view.hr.image.shape[0] * view.hr.image.shape[1])
        + state.skip_policy.coarse_bytes(state.views, state.t),
        kept=0 if cuda else _KEPT,
        cuda=cuda,
    )


def require(needed: Needs, budget: int | None, most: int | None) -> None:
    """Refuse a run whose start does not fit; warn where it cannot grow as far as it may.

    Args:
        budget: bytes; None: what is free on this machine, if that is known. most: Gaussians that the density allows.

    Raises:
        SettingError: the first Gaussians need more than the budget.
    """
    allowed = budget if budget is not None else available(needed)
    if allowed is None:
        return
    start = needed.peak(needed.gaussians)
    source = "fit.memory allows" if budget is not None else "is free on this machine"
    if start > allowed:
        raise SettingError(
            f"fit.memory: {needed.gaussians:,} Gaussians need {mebibytes(start)} MiB, and {mebibytes(allowed)} MiB {source}. "
            "Raise data.views.shrink, lower fit.max_degree or data.cloud.max_points, or raise fit.memory."
        )
    fits = needed.fits(allowed)
    if most is not None and fits < most:
        _log.warning(
            "%d Gaussians, the most that there may be, need %d MiB, and %d MiB %s: %d fit.",
            most, mebibytes(needed.peak(most)), mebibytes(allowed), source, fits,
        )  # fmt: skip


def summary(needed: Needs, most: int | None) -> str:
    """A line of the run's printed plan."""
    n = needed.gaussians
    more = (needed.peak(10 * n + 10**6) - needed.peak(9 * n + 10**6)) / n
    line = f"{mebibytes(needed.peak(n))} MiB at the start ({mebibytes(needed.reached)} MiB were taken until now)"
    line += f", {more / 1024:.1f} KiB for each further Gaussian"
    if most is None:
        return line
    return f"{line}, {mebibytes(needed.peak(most))} MiB with {most:,}, the most that there may be"


def release() -> None:
    """Give the system what has been freed, which the C library keeps: loading and training leave hundreds of MiB."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:  # glibc
        trim(0)


def mebibytes(size: int) -> int:
    return -(-size // _MIB)


def resident() -> int:
    """Bytes that the process holds now; 0 without /proc."""
    return system_bytes("/proc/self/status", "VmRSS") or 0


def peak() -> int:
    """The most bytes that the process has held; 0 without /proc."""
    return system_bytes("/proc/self/status", "VmHWM") or 0


def available(needed: Needs) -> int | None:
    """Bytes that training may take on this machine, those that it holds already included; None without /proc."""
    if needed.cuda:
        return int(torch.cuda.mem_get_info()[0]) + needed.now
    free = system_bytes("/proc/meminfo", "MemAvailable")
    return None if free is None else free + needed.now


def system_bytes(file: str, name: str) -> int | None:
    """An entry of a file of /proc; None where there is none."""
    try:
        lines = dict(line.split(":", 1) for line in Path(file).read_text().splitlines())
        return int(lines[name].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return None
