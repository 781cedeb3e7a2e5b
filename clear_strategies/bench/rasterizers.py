"""Time, memory and error of every rasterizer at every preset of cut-offs.

Each contender is compared with float64 twice: at its own cut-offs, which shows the rounding, and without cut-offs, which shows
the cut-offs too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import pandas as pd
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

import rasterizers
from clear_strategies.bench import accuracy, scenes
from clear_strategies.bench.accuracy import NO_CUT_OFFS, Drawn, affordable
from clear_strategies.bench.results import Results, line_chart
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.bench.timing import interleaved, medians, milliseconds, queued
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import DataError
from rasterizers.interface import PRESETS

COTANGENTS: Final = 3
FORWARD, TOGETHER, SEPARATE, LATENCY = "forward", "lr_hr_together", "lr_hr_separate", "latency"
BACKWARD: Final = tuple(f"backward_k{k}" for k in range(1, COTANGENTS + 1))
SAME, NONE = "same cut-offs", "no cut-offs"


@dataclass(frozen=True, slots=True, eq=False)
class Contestant:
    """A backend at a preset on a scene.

    Args:
        names: the columns that say what a row of a table measured.
        render: draws the scene.
        stages: times more stages than forward and backward.
    """

    names: Mapping[str, str]
    render: Callable[[], Any]
    stages: Callable[[WorkLog], None]

    @property
    def label(self) -> str:
        return " ".join(name for name in list(self.names.values())[1:] if name)


def measure(
    results: Results, *, scene: Sequence[str], backend: Sequence[str], preset: Sequence[str], repeats: int, device: str
) -> None:
    """Measure the scenes one after the other.

    Args:
        backend: none: all that run here.

    Raises:
        DataError: a name is unknown, or nothing that was asked for runs here.
    """
    require_device(device)
    backends, truth = usable(backend, device, results.note), accuracy.truth_backend()
    workloads = [scenes.load(name).to(device) for name in scene]
    times, errors, turns = list[dict[str, Any]](), list[dict[str, Any]](), list[pd.DataFrame]()
    for workload in workloads:
        results.log(f"{workload.name}: {len(workload.splats):,} Gaussians")
        affordable_here = [b for b in backends if affordable(b, workload, b, results.note)]
        contestants = [backend_on(workload, b, p) for b in affordable_here for p in preset if p in presets_of(b)]
        if not contestants:
            continue
        contenders = {c.label: partial(turn, c, random_cotangents(workload)) for c in contestants}
        ms = interleaved(contenders, repeats, device=device, label=workload.name)
        turns.append(ms.assign(scene=workload.name))
        times += _time_rows(workload, contestants, medians(ms))
        if affordable(truth, workload, "errors", results.note):
            errors += _error_rows(workload, contestants, truth)
    if not times:
        raise DataError("--backend", ", ".join(backends), "measures none of these scenes", "see the lines above")
    results.tables |= {"rasterizers_time": pd.DataFrame(times), "rasterizers_turns": pd.concat(turns)}
    if errors:
        results.tables["rasterizers_error"] = pd.DataFrame(errors)
        results.figures["time_against_error"] = figure(pd.DataFrame(times), pd.DataFrame(errors))


def figure(time: pd.DataFrame, error: pd.DataFrame) -> Figure:
    """A line per backend through its presets; lower left is better."""
    rows = time.merge(error[error["truth"] == NONE], on=["scene", "backend", "module", "preset"])
    rows["name"] = (rows["backend"] + " " + rows["module"].fillna("")).str.strip()  # empty in a CSV
    rows["forward + backward, ms"] = rows["forward_ms"] + rows["backward_k1_ms"]
    error_of = "error of the gradient of the means,\nrelative L2, against float64"
    rows = rows.assign(line="").rename(columns={"preset": "mark", "means_relative": error_of})
    return line_chart(rows, "forward + backward, ms", error_of, log=True)


def require_device(device: str) -> None:
    """Refuse a device that torch does not see."""
    if device == "cuda" and not torch.cuda.is_available():
        raise DataError("--device", "cuda", "torch sees no such device here", "use --device cpu")


def usable(asked: Sequence[str], device: str, note: Callable[[str], None]) -> list[str]:
    """The backends that run on the device, of those in `asked`, or of all. A DataError where a name is unknown, or none runs."""
    reasons = rasterizers.available()
    for name in asked:
        if name not in reasons:
            raise DataError("--backend", name, "is no backend", f"choose from {', '.join(reasons)}")
    for name in dict.fromkeys(asked or reasons):
        if reasons[name] is None and name == "warp" and device == "cpu" and not asked:
            reasons[name] = "made for CUDA; name it with --backend to measure it on a CPU"
        elif reasons[name] is None and device not in rasterizers.load(name).traits.devices:
            reasons[name] = f"it does not run on {device}"
        if reasons[name] is not None:
            note(f"{name}: {reasons[name]}")
    names = [name for name in dict.fromkeys(asked or reasons) if reasons[name] is None]
    if not names:
        raise DataError("--backend", ", ".join(asked), "cannot run here", "see the lines above")
    return names


def presets_of(backend: str) -> Sequence[str]:
    """The presets that a backend draws at: gsplat's cut-offs are fixed."""
    return ["fast"] if backend == "gsplat" else list(PRESETS)


def turn(contestant: Contestant, cotangents: Float[Tensor, "K H W 3"]) -> dict[str, float]:
    """The milliseconds of every stage of a contestant, once; on CUDA also those of a forward and a backward pass (K = 2) that
    start on an idle device, by the host's clock.
    """
    work_log, device = WorkLog(cotangents.device), cotangents.device
    with queued(work_log, FORWARD):
        rendering = contestant.render()
    for k, stage in enumerate(BACKWARD, 1):
        with queued(work_log, stage):
            rendering.vjp(cotangents[:k])
    del rendering
    contestant.stages(work_log)
    ms = milliseconds(work_log)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        began = time.perf_counter()
        contestant.render().vjp(cotangents[:2])
        torch.cuda.synchronize(device)
        ms[LATENCY] = 1e3 * (time.perf_counter() - began)
    return ms


def random_cotangents(workload: Workload) -> Float[Tensor, "K H W 3"]:
    """Standard normal, the same for every contestant."""
    camera, generator = workload.camera, torch.Generator().manual_seed(0)
    values = torch.randn(COTANGENTS, camera.height, camera.width, 3, generator=generator)
    return values.to(workload.splats.means.device)


def backend_on(workload: Workload, backend: str, preset: str) -> Contestant:
    """A backend; it also times both scales, together and one after the other."""
    rasterizer = rasterizers.load(backend, preset=preset, **SETTINGS)
    splats, camera = workload.splats, workload.camera
    lr = camera.scaled(1 / workload.lr_factor)

    def stages(work_log: WorkLog) -> None:
        with queued(work_log, TOGETHER):
            rasterizer.render_scales([(splats, lr), (splats, camera)])
        with queued(work_log, SEPARATE):
            rasterizer(splats, lr)
            rasterizer(splats, camera)

    module = getattr(rasterizer, "module", "")  # the instruction set of the compiled backend
    names = {"scene": workload.name, "backend": backend, "module": module, "preset": preset}
    return Contestant(names, lambda: rasterizer(splats, camera), stages)


def peak_on_cuda(c: Contestant, cotangents: Float[Tensor, "K H W 3"]) -> float:
    """MiB that torch's allocator adds at the peak of a forward and a backward pass."""
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    c.render().vjp(cotangents)
    torch.cuda.synchronize()
    return float(torch.cuda.max_memory_allocated() - before) / 2**20


def _time_rows(workload: Workload, contestants: Sequence[Contestant], median: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Milliseconds, the ratios that say whether shared work pays, and on CUDA the peak of memory."""
    cotangents = random_cotangents(workload)
    for c in contestants:
        ms = median.loc[c.label].dropna().to_dict()
        row: dict[str, Any] = {**c.names} | {f"{stage}_ms": value for stage, value in ms.items() if stage != SEPARATE}
        row |= {f"k{k}_over_k1": ms[BACKWARD[k - 1]] / ms[BACKWARD[0]] for k in range(2, COTANGENTS + 1)}
        if SEPARATE in ms:
            row["together_over_separate"] = ms[TOGETHER] / ms[SEPARATE]
        if cotangents.is_cuda:
            row["peak_mib"] = peak_on_cuda(c, cotangents[:2])
        yield row


def _error_rows(workload: Workload, contestants: Sequence[Contestant], backend: str) -> Iterator[dict[str, Any]]:
    """Two rows per contestant: against float64 at its own cut-offs, and without any."""
    cotangent = random_cotangents(workload)[0]
    truths: dict[tuple[Any, ...], Drawn] = {}
    for c in contestants:
        drawn = accuracy.draw(c.render, cotangent)
        for against, cut_offs in ((SAME, PRESETS[c.names["preset"]]), (NONE, NO_CUT_OFFS)):
            key = tuple(sorted(cut_offs.items()))
            if key not in truths:
                truths[key] = accuracy.truth(backend, workload, cotangent, cut_offs)
            yield {**c.names, "truth": against, **accuracy.errors(drawn, truths[key])}
