"""Time, memory and error of every rasterizer at every preset of cut-offs.

Each contender is compared with float64 twice: at its own cut-offs, which shows the error of rounding, and without cut-offs, which
includes that of the cut-offs.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

import rasterizers
from clear_strategies.bench import scenes
from clear_strategies.bench.results import Results, interleaved, medians, milliseconds, queued
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import DataError
from clear_strategies.outputs.figures import new_figure
from rasterizers.interface import PRESETS, Rasterizer, Rendering

_log = logging.getLogger(__name__)

COTANGENTS: Final = 3
FORWARD, TOGETHER, SEPARATE, LATENCY = "forward", "lr_hr_together", "lr_hr_separate", "latency"
BACKWARD: Final = tuple(f"backward_k{k}" for k in range(1, COTANGENTS + 1))
SAME, NONE = "same cut-offs", "no cut-offs"


ATTRIBUTES: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")
NO_CUT_OFFS: Final = {"alpha_min": 1e-9, "transmittance_min": 0.0}
REFERENCE_LIMIT: Final = 10_000  # Gaussians; with more, the pure-torch reference takes minutes per turn

ImageAndGradients = Mapping[str, Tensor]
"""An image, and the gradients of one cotangent by attribute, in main memory."""


class Contestant:
    """A backend at a preset on a scene. Called, it returns the milliseconds of every stage, once."""

    def __init__(self, workload: Workload, backend: str, preset: str) -> None:
        self.rasterizer = rasterizers.load(backend, preset=preset, **SETTINGS)
        self.workload, self.cotangents = workload, random_cotangents(workload)
        module = getattr(self.rasterizer, "module", "")  # the instruction set of the compiled backend
        self.names = {"scene": workload.name, "backend": backend, "module": module, "preset": preset}
        self.label = " ".join(name for name in (backend, module, preset) if name)

    def render(self) -> Rendering:
        return self.rasterizer(self.workload.splats, self.workload.camera)

    def __call__(self) -> dict[str, float]:
        """Time forward and backward passes, and both scales together and one after the other; on CUDA also a forward and a
        backward pass (K = 2) that start on an idle device, by the host's clock.
        """
        device, splats, hr = self.cotangents.device, self.workload.splats, self.workload.camera
        work_log, lr = WorkLog(device), hr.scaled(1 / self.workload.lr_factor)
        with queued(work_log, FORWARD):
            rendering = self.render()
        for k, stage in enumerate(BACKWARD, 1):
            with queued(work_log, stage):
                rendering.vjp(self.cotangents[:k])
        del rendering
        with queued(work_log, TOGETHER):
            self.rasterizer.render_scales([(splats, lr), (splats, hr)])
        with queued(work_log, SEPARATE):
            self.rasterizer(splats, lr)
            self.rasterizer(splats, hr)
        ms = milliseconds(work_log)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
            began = time.perf_counter()
            self.render().vjp(self.cotangents[:2])
            torch.cuda.synchronize(device)
            ms[LATENCY] = 1e3 * (time.perf_counter() - began)
        return ms

    def peak_on_cuda(self) -> float:
        """MiB that torch's allocator adds at the peak of a forward and a backward pass."""
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        self.render().vjp(self.cotangents[:2])
        torch.cuda.synchronize()
        return float(torch.cuda.max_memory_allocated() - before) / 2**20


def measure(
    results: Results, *, scene: Sequence[str], backend: Sequence[str], preset: Sequence[str], repeats: int, device: str
) -> None:
    """Measure the scenes one after the other.

    Args:
        backend: names; empty: all that run here.
    """
    require_device(device)
    backends, truth = usable(backend, device, results.note), truth_backend()
    workloads = [scenes.load(name).to(device) for name in scene]
    times, errors, turns = list[dict[str, Any]](), list[dict[str, Any]](), list[pd.DataFrame]()
    for workload in workloads:
        _log.info("%s: %s Gaussians", workload.name, f"{len(workload.splats):,}")
        affordable_here = [b for b in backends if affordable(b, workload, b, results.note)]
        # gsplat's cut-offs are fixed.
        pairs = [(b, p) for b in affordable_here for p in preset if b != "gsplat" or p == "fast"]
        contestants = [Contestant(workload, *pair) for pair in pairs]
        if not contestants:
            continue
        ms = interleaved({c.label: c for c in contestants}, repeats, device=device, label=workload.name)
        turns.append(ms.assign(scene=workload.name))
        times += _time_rows(contestants, medians(ms))
        if affordable(truth, workload, "errors", results.note):
            errors += _error_rows(workload, contestants, truth)
    if not times:
        raise DataError("--backend", ", ".join(backends), "measures none of these scenes", "see the lines above")
    results.tables |= {"rasterizers_time": pd.DataFrame(times), "rasterizers_turns": pd.concat(turns)}
    if errors:
        results.tables["rasterizers_error"] = pd.DataFrame(errors)
        results.figures["time_against_error"] = figure(pd.DataFrame(times), pd.DataFrame(errors))


def figure(time: pd.DataFrame, error: pd.DataFrame) -> Figure:
    """Draw a panel per scene, with a line per backend through its presets; lower left is better."""
    rows = time.merge(error[error["truth"] == NONE], on=["scene", "backend", "module", "preset"])
    rows["name"] = (rows["backend"] + " " + rows["module"].fillna("")).str.strip()  # empty in a CSV
    rows["ms"] = rows["forward_ms"] + rows["backward_k1_ms"]
    scenes, names = rows["scene"].unique(), rows["name"].unique()
    drawn, (panels,) = new_figure(1, len(scenes), 1.2 + 2 * len(scenes), 3.2)
    for axis, scene in zip(panels, scenes, strict=True):
        for i, name in enumerate(names):
            points = rows[(rows["scene"] == scene) & (rows["name"] == name)]
            label = name if axis is panels[0] else None
            axis.plot(points["ms"], points["means_relative"], "o-", markersize=3, color=f"C{i}", label=label)
            for preset, *point in points[["preset", "ms", "means_relative"]].itertuples(index=False):
                axis.annotate(preset, point, (5, 3), textcoords="offset points", fontsize=8, color="gray")
        axis.set(title=scene, xlabel="forward + backward, ms", yscale="log")
        if axis is not panels[0]:
            axis.sharey(panels[0])
        axis.label_outer()
        axis.margins(x=0.4, y=0.15)
        axis.grid(alpha=0.25)
    panels[0].set_ylabel("error of the means' gradient,\nrelative L2, against float64")
    drawn.legend(loc="outside lower left", fontsize=8, ncols=max(1, min(len(names), 2 * len(scenes))))
    return drawn


def require_device(device: str) -> None:
    """Raise a DataError for a device that torch does not find."""
    if device == "cuda" and not torch.cuda.is_available():
        raise DataError("--device", "cuda", "torch sees no such device here", "use --device cpu")


def usable(asked: Sequence[str], device: str, note: Callable[[str], None]) -> list[str]:
    """The backends that run on the device, of those in `asked`, or of all; a DataError if a name is unknown, or none runs."""
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


def random_cotangents(workload: Workload) -> Float[Tensor, "K H W 3"]:
    """Standard normal cotangents, the same for every contestant."""
    camera, generator = workload.camera, torch.Generator().manual_seed(0)
    values = torch.randn(COTANGENTS, camera.height, camera.width, 3, generator=generator)
    return values.to(workload.splats.means.device)


def _time_rows(contestants: Sequence[Contestant], median: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """A row per contestant: milliseconds, ratios that show the gain of shared work, and on CUDA the peak of memory."""
    for c in contestants:
        ms = median.loc[c.label].dropna().to_dict()
        row: dict[str, Any] = {**c.names} | {f"{stage}_ms": value for stage, value in ms.items() if stage != SEPARATE}
        row |= {f"k{k}_over_k1": ms[BACKWARD[k - 1]] / ms[BACKWARD[0]] for k in range(2, COTANGENTS + 1)}
        row["together_over_separate"] = ms[TOGETHER] / ms[SEPARATE]
        if c.cotangents.is_cuda:
            row["peak_mib"] = c.peak_on_cuda()
        yield row


def _error_rows(workload: Workload, contestants: Sequence[Contestant], backend: str) -> Iterator[dict[str, Any]]:
    """Two rows per contestant: against float64 at its own cut-offs, and without any."""
    cotangent = random_cotangents(workload)[0]
    truths: dict[tuple[Any, ...], ImageAndGradients] = {}
    for c in contestants:
        drawn = draw(c.render, cotangent)
        for against, cut_offs in ((SAME, PRESETS[c.names["preset"]]), (NONE, NO_CUT_OFFS)):
            key = tuple(sorted(cut_offs.items()))
            if key not in truths:
                truths[key] = truth_of(backend, workload, cotangent, cut_offs)
            yield {**c.names, "truth": against, **errors_of(drawn, truths[key])}


def draw(render: Callable[[], Any], cotangent: Float[Tensor, "H W 3"]) -> ImageAndGradients:
    """Render, and backpropagate one cotangent.

    Args:
        render: returns an object with `image`, and `vjp` of K cotangents.
    """
    rendering = render()
    g = rendering.vjp(cotangent[None])
    return {"image": rendering.image.detach().cpu(), **{name: getattr(g, name)[0].cpu() for name in ATTRIBUTES}}


def errors_of(measured: ImageAndGradients, truth: ImageAndGradients) -> dict[str, float]:
    """Table columns: absolute errors of the image, and relative L2 errors of each attribute's gradient.

    `<attribute>_relative` is over all Gaussians, `<attribute>_median` the median of the Gaussians' relative errors.
    """
    difference = (measured["image"].double() - truth["image"].double()).abs().numpy()
    columns = {
        "image_max": float(difference.max()),
        "image_p99.99": float(np.quantile(difference, 0.9999)),
        "image_mean": float(difference.mean()),
    }
    for name in ATTRIBUTES:
        x, expected = (drawn[name].double().reshape(len(truth[name]), -1) for drawn in (measured, truth))
        size = expected.norm(dim=1)
        of_each = ((x - expected).norm(dim=1) / size)[size > 0]
        columns[f"{name}_relative"] = relative(x, expected)
        columns[f"{name}_median"] = float(of_each.median()) if len(of_each) else 0.0
    return columns


def relative(measured: Tensor, truth: Tensor) -> float:
    """The relative L2 error; the absolute one where the truth is 0."""
    truth = truth.double()
    size, error = float(truth.norm()), float((measured.to(truth) - truth).norm())
    return error / size if size > 0 else error


def affordable(backend: str, workload: Workload, what: str, note: Callable[[str], None]) -> bool:
    """Return True if a backend draws this scene in seconds, else call `note` with the reason."""
    if backend != "torch" or len(workload.splats) <= REFERENCE_LIMIT:
        return True
    note(f"{what}, {workload.name}: the torch reference takes at most {REFERENCE_LIMIT:,} Gaussians here.")
    return False


def truth_backend() -> str:
    """The fastest available backend that computes in float64, on any device."""
    runs = (name for name, why_not in rasterizers.available().items() if why_not is None)
    return next(name for name in runs if torch.float64 in rasterizers.load(name).traits.dtypes)


def in_float64(backend: str, workload: Workload, rules: Mapping[str, Any]) -> tuple[Rasterizer, Workload]:
    """A rasterizer, and the workload in float64, on the workload's device if the rasterizer draws there, else on the CPU.

    Args:
        rules: the cut-offs, and settings that differ from `SETTINGS`.
    """
    rasterizer = rasterizers.load(backend, **{**SETTINGS, **rules})
    device = workload.splats.means.device.type
    return rasterizer, workload.to(device if device in rasterizer.traits.devices else "cpu", torch.float64)


def truth_of(
    backend: str, workload: Workload, cotangent: Float[Tensor, "H W 3"], rules: Mapping[str, Any]
) -> ImageAndGradients:
    """The image and gradients in float64."""
    rasterizer, wide = in_float64(backend, workload, rules)
    return draw(lambda: rasterizer(wide.splats, wide.camera), cotangent.to(wide.splats.means))
