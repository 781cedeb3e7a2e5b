"""How long does one iteration of training take, stage by stage, and what would it cost without L_HF, and without HR?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

import rasterizers
from clear_strategies.bench import counting, scenes
from clear_strategies.bench.counting import Cost
from clear_strategies.bench.output import UNKNOWN, Findings, Section, number, times
from clear_strategies.bench.peaks import Peaks, attained
from clear_strategies.bench.prototype import Prototype, started
from clear_strategies.bench.rasterizers import noise, require_device, usable
from clear_strategies.bench.rounds import WARM_UPS, Contender, Milliseconds, bar, interleaved, medians, milliseconds
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.core import images
from clear_strategies.core.view import Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.density.adaptive import Density, DensitySettings
from clear_strategies.errors import DataError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.objective import Objective
from clear_strategies.schedules import LogLinear, WarmupDecay
from clear_strategies.strategies.base import Strategy
from clear_strategies.strategies.gco import GCO
from clear_strategies.strategies.p2g import P2G
from clear_strategies.strategies.svs import SVS
from clear_strategies.training.compiled_step import compiled_step_for
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import iterate, kernel_threads
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers.interface import PRESETS, Rasterizer, Splats

# As conf/strategy has them.
_HELD: Final = {
    "means": 1e-4, "scales": 1e-4, "quats": 1e-4, "opacities": 1e-5, "sh0": 1e-6, "shN": 1e-6, "detail": 1e-6,
}  # fmt: skip


def _p2g() -> P2G:
    return P2G(score_by="sum")


def _svs() -> SVS:
    return SVS(anchor_weights=_HELD)


STRATEGIES: Final[Mapping[str, Callable[[], tuple[Strategy, ...]]]] = {
    "baseline": tuple,
    "gco": lambda: (GCO(),),
    "p2g": lambda: (_p2g(),),
    "svs": lambda: (_svs(),),
    "clear": lambda: (GCO(), _p2g(), _svs()),
}
STILL: Final = LearningRates(LogLinear(1e-30, 1e-30), *(0.0,) * 6, detail_decay=0.002)
"""Adam does all its work, and the scene stays what it is, turn after turn."""

TARGETS: Final[Mapping[tuple[int, int], float]] = {(1008, 756): 6.0, (2016, 1512): 12.0}
"""Milliseconds of a full iteration of 100,000 to 300,000 Gaussians on a GPU of the H200's class, by the size of HR."""

_TOTAL, _REST = "total", "everything else"
_WITHOUT_HF, _LR_ONLY = "K=1 (no L_HF)", "LR only"
_TOGETHER: Final = {"cpu": 1, "cuda": 16}  # iterations of a turn: on CUDA one is launched while the last is computed
_PEER: Final = "prototype, plain HR forward + backward"
_NOISE: Final = 0.02  # of the photos, in image units


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for on the command line; `backend` None is the fastest that runs here."""

    scene: str
    strategy: str
    backend: str | None
    preset: str
    repeats: int
    data: Path | None = None
    prototype: Path | None = None
    device: str = "cpu"
    floors: bool = False


class Training:
    """A run in its middle, t_a behind it: HR at full weight, dropout, evidence, correction and anchor are all on."""

    def __init__(self, workload: Workload, view: View, rasterizer: Rasterizer, conductor: Conductor) -> None:
        field, device = field_of(workload.splats), workload.splats.means.device
        # Held from turning off after t_a, so that statistics are gathered; rounds of densification come too rarely.
        density = Density(DensitySettings(stop=10_000), len(field), extent=1.0, seed=0, device=device)
        settings = FitSettings(degree_every=1)
        conductor.on_fit_start(1, 0, device)
        optimizer = Adam(field.raw(), STILL, 1.0)
        self.state = TrainState(
            field, conductor, optimizer, density, settings, MipFilter(), (view,),
            t=SVS().anchor_start, compiled_step=compiled_step_for(conductor, optimizer),
        )  # fmt: skip
        self.state.refilter()
        self.rasterizer = rasterizer
        iterate(self.state, rasterizer)  # takes the anchor

    def __call__(self) -> Milliseconds:
        device = self.state.field.means.device
        together = _TOGETHER[device.type]
        whole, self.state.conductor.work_log = WorkLog(device), WorkLog(device)
        with whole.stage(_TOTAL):
            for _ in range(together):
                iterate(self.state, self.rasterizer)
        stages = {name: ms / together for name, ms in milliseconds(self.state.conductor.work_log).items()}
        # What was skipped is no stage. "render LR" and "render LR + HR" are one.
        stages = {name.split()[0] if name.startswith("render") else name: ms for name, ms in stages.items() if ms > 0}
        total = milliseconds(whole)[_TOTAL] / together
        return {**stages, _REST: max(0.0, total - sum(stages.values())), _TOTAL: total}


def measure(request: Request, say: Callable[[str], None]) -> Findings:
    """A full iteration, one without L_HF, one without HR, and the prototype's forward and backward, taking turns.

    Raises:
        DataError: a name is unknown, the scene has no LR grid, or there is no such device.
    """
    findings = Findings("iteration", torch.get_num_threads())

    def skip(line: str) -> None:
        say(line)
        findings.skipped.append(line)

    require_device(request.device)
    workload = scenes.load(request.scene, request.data)
    if isinstance(workload, str):
        raise DataError("--scene", request.scene, workload, "or take another scene")
    workload = workload.to(request.device)
    (backend,) = usable([request.backend or rasterizers.fastest(request.device)], request.device, skip)
    rasterizer = rasterizers.load(backend, preset=request.preset, **SETTINGS)
    view = view_of(workload, rasterizer)
    full = f"{request.strategy}, LR + HR"
    trainings = _trainings(request, full, workload, view, rasterizer)
    turns: dict[str, Contender] = {**trainings}
    with started(request.prototype, findings.threads) if request.device == "cpu" else _no_prototype() as peer:
        if isinstance(peer, str):
            skip(f"prototype: {peer}.")
        else:
            peer.scene(workload, noise(workload))
            turns[_PEER] = _plain(peer, PRESETS[request.preset])
        warm_ups = WARM_UPS[request.device]
        progress_bar = bar(len(turns) * (request.repeats + warm_ups), request.strategy)
        with progress_bar as progress, kernel_threads(trainings[full].state, rasterizer):
            ms = interleaved(turns, request.repeats, warm_ups=warm_ups, progress=progress)
    size = f"LR {view.lr.camera.width}x{view.lr.camera.height} + HR {view.hr.camera.width}x{view.hr.camera.height}"
    title = (
        f"{request.strategy} on {workload.name}: {len(workload.splats):,} Gaussians, {size}, {backend} {request.preset}"
    )
    median = {name: medians(stages) for name, stages in ms.items()}
    findings.sections = [_section(title, full, median, _target(view, request.device))]
    if request.floors:
        rules = {**SETTINGS, **PRESETS[request.preset]}
        costs = floors(workload, view, rules, anchored=request.strategy in ("clear", "svs"))
        took = {(full, stage): ms for stage, ms in median[full].items()}
        heading = f"{workload.name}: how near a full iteration comes to the device's limits"
        findings.sections.append(attained(heading, took, costs, Peaks.measured(request.device)))
    findings.raw = {
        "scene": workload.name, "strategy": request.strategy, "backend": backend, "preset": request.preset,
        "device": request.device, "settings": SETTINGS, "ms": ms,
    }  # fmt: skip
    return findings


def _trainings(
    request: Request, full: str, workload: Workload, view: View, rasterizer: Rasterizer
) -> dict[str, Training]:
    """The same training three times, with less and less to listen to."""
    without_hr = Objective(lambda_hr=WarmupDecay(peak=0.0, final=0.0))
    conductors = {
        full: Conductor(*STRATEGIES[request.strategy](), objective=Objective(), statistics_from=500),
        _WITHOUT_HF: Conductor(
            *STRATEGIES[request.strategy](), objective=Objective(lambda_hf=0.0), statistics_from=500
        ),
        _LR_ONLY: Conductor(*STRATEGIES[request.strategy](), objective=without_hr),
    }
    return {name: Training(workload, view, rasterizer, conductor) for name, conductor in conductors.items()}


def floors(workload: Workload, view: View, rules: Mapping[str, Any], *, anchored: bool) -> dict[str, Cost]:
    """By stage of a full iteration; "total" is their sum."""
    hr = counting.load_of(workload, rules)
    lr = counting.load_of(replace(workload, camera=view.lr.camera), rules)
    losses = counting.photometric(3 * hr.pixels) + counting.haar(3 * hr.pixels)
    costs = {
        "render": counting.forward(lr) + counting.forward(hr),
        "losses LR": counting.photometric(3 * lr.pixels),
        "backward LR": counting.backward(lr, 1),
        "losses HR": losses,
        "backward HR": counting.backward(hr, 2),
        "per-Gaussian pass": counting.gaussian_pass(hr.n, hr.bands, 3, anchored=anchored),
    }
    return {**costs, _TOTAL: sum(costs.values(), Cost(0, 0))}


def field_of(splats: Splats) -> GaussianField:
    """The field that draws these splats when no 3D filter is on."""
    eps = torch.finfo(torch.float32).eps
    offset = splats.rgb_offset
    parameters: dict[str, Tensor] = {
        "means": splats.means,
        "quats": splats.quats,
        "scales": splats.scales.log(),
        "opacities": torch.logit(splats.opacities.clamp(eps, 1 - eps)),
        "sh0": splats.sh0,
        "shN": splats.shN,
        "detail": offset if offset is not None else torch.zeros_like(splats.means),
    }
    field = GaussianField(parameters)
    field.degree = field.max_degree
    return field


def view_of(workload: Workload, rasterizer: Rasterizer) -> View:
    """One view whose photos are a render plus noise.

    Raises:
        DataError: no LR grid divides the image.
    """
    factor, camera = workload.lr_factor, workload.camera
    if factor is None:
        size = f"{camera.width}x{camera.height} is no multiple of 4, 3 or 2"
        raise DataError("--scene", workload.name, size, "take another scene")
    clean = rasterizer(workload.splats, camera).image
    generator = torch.Generator().manual_seed(1)

    def noisy(image: Tensor) -> Tensor:
        return (image + _NOISE * torch.randn(image.shape, generator=generator).to(image.device)).clamp(0, 1)

    lr = Photo(camera.scaled(1 / factor), noisy(images.downsample(clean, factor)))
    return View("bench", lr, Photo(camera, noisy(clean)), sr_source="render plus noise")


def _plain(prototype: Prototype, cuts: Mapping[str, float]) -> Contender:
    def turn() -> Milliseconds:
        stages = {"forward": prototype.forward(cuts), "backward K=1": prototype.backward(1)}
        return {**stages, _TOTAL: sum(stages.values())}

    return turn


def _no_prototype() -> AbstractContextManager[Prototype | str]:
    return nullcontext("it draws on CPUs only")


def _target(view: View, device: str) -> float | None:
    """Milliseconds; None where none was set."""
    return TARGETS.get((view.hr.camera.width, view.hr.camera.height)) if device == "cuda" else None


def _section(title: str, full: str, median: Mapping[str, Mapping[str, float]], target: float | None) -> Section:
    ours = [name for name in (full, _WITHOUT_HF, _LR_ONLY) if name in median]
    stages = [s for s in dict.fromkeys(stage for name in ours for stage in median[name]) if s not in (_REST, _TOTAL)]
    stages += [_REST, _TOTAL]
    columns = {"stage": stages}
    for name in ours:
        columns[f"{name}, ms"] = [number(median[name][s]) if s in median[name] else UNKNOWN for s in stages]
    total = median[full][_TOTAL]
    of_full = {name: times(median[name][_TOTAL] / total) for name in (_WITHOUT_HF, _LR_ONLY)}
    minutes = total * 10 / 60
    notes = [
        f"Medians by stage, so they need not add up. 10,000 such iterations take {minutes:.{1 if minutes < 10 else 0}f} minutes. "
        f"An iteration without L_HF costs {of_full[_WITHOUT_HF]}, without the HR scale {of_full[_LR_ONLY]} of a full one."
    ]
    if target is not None:
        notes.append(
            f"Target at this size: {target:g} ms; {'reached' if total <= target else 'missed'} ({number(total)} ms)."
        )
    if _PEER in median:
        plain = median[_PEER][_TOTAL]
        notes.append(
            f"{_PEER[0].upper()}{_PEER[1:]}, in the same turns: {number(plain)} ms; the full iteration is "
            f"{times(total / plain)} that."
        )
    return Section(title, columns, notes)
