"""What the device can do at most, measured, and how near a stage comes to it.

Bandwidth: a large copy from the device's memory to itself, counting what is read and what is written. Arithmetic: a large
product of float32 matrices, tensor cores off, two operations a multiply-add; of all float32 code in reach it comes nearest to
the sum of the cores. Each the best of several rounds. Data sheets promise more; nobody gets it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import torch

from clear_strategies.bench.counting import FLOAT, Cost
from clear_strategies.bench.output import Section, number
from clear_strategies.core.work_log import WorkLog

_log = logging.getLogger(__name__)

_ROUNDS: Final = 7
_COPIED: Final = {"cpu": 1 << 24, "cuda": 1 << 28}  # numbers: beyond any cache
_SIDE: Final = {"cpu": 1024, "cuda": 8192}  # of the matrices


@dataclass(frozen=True, slots=True)
class Peaks:
    """bandwidth: bytes/s, read and written. flops: float32 operations/s."""

    bandwidth: float
    flops: float

    @classmethod
    def measured(cls, device: str) -> Peaks:
        """On this device, now."""
        source = torch.rand(_COPIED[device], device=device)
        target = torch.empty_like(source)
        bandwidth = 2 * FLOAT * len(source) / _best_seconds(lambda: target.copy_(source), device)
        side = _SIDE[device]
        a, b = torch.rand(2, side, side, device=device)
        out = torch.empty_like(a)
        before = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")
        try:
            flops = 2 * side**3 / _best_seconds(lambda: torch.mm(a, b, out=out), device)
        finally:
            torch.set_float32_matmul_precision(before)
        found = cls(bandwidth, flops)
        _log.info("limits of this device: %s", found.says())
        return found

    def ms(self, cost: Cost) -> float:
        """The floor: no less than its bytes and no less than its operations take."""
        return 1e3 * max(cost.bytes / self.bandwidth, cost.flops / self.flops)

    def says(self) -> str:
        return f"a copy moved {self.bandwidth / 1e9:,.0f} GB/s, a float32 matrix product ran at {self.flops / 1e12:.3g} TFLOP/s."


def attained(
    title: str, ms: Mapping[tuple[str, str], float], costs: Mapping[str, Cost], peaks: Peaks, note: str = ""
) -> Section:
    """(who, stage) -> milliseconds, beside the stage's floor."""
    rows = [(who, stage, took, costs[stage]) for (who, stage), took in ms.items() if stage in costs]
    columns = {
        "who": [who for who, *_ in rows],
        "stage": [stage for _, stage, *_ in rows],
        "ms": [number(took) for *_, took, _ in rows],
        "MB at least": [number(cost.bytes / 1e6) for *_, cost in rows],
        "of the bandwidth": [_share(1e3 * cost.bytes / peaks.bandwidth / took) for *_, took, cost in rows],
        "MFLOP at least": [number(cost.flops / 1e6) for *_, cost in rows],
        "of the arithmetic": [_share(1e3 * cost.flops / peaks.flops / took) for *_, took, cost in rows],
        "floor, ms": [number(peaks.ms(cost)) for *_, cost in rows],
    }
    legend = (
        "Floors are counted by the method's definition, each number through memory once (bench/counting.py), and held against "
        f"what this device was measured to do: {peaks.says()} What stays in a cache from turn to turn can pass 100 %."
    )
    return Section(title, columns, tuple(line for line in (note, legend) if line))


def _share(value: float) -> str:
    return f"{100 * value:.3g} %"


def _best_seconds(work: Callable[[], object], device: str) -> float:
    best = float("inf")
    for _ in range(_ROUNDS):
        work_log = WorkLog(device)
        with work_log.stage("work"):
            work()
        best = min(best, work_log.entries["work"].seconds)
    return best
