"""How long does one iteration of training take, stage by stage, and what would it cost without the HR scale?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

import rasterizers
from clear_strategies import images
from clear_strategies.bench import scenes
from clear_strategies.bench.output import UNKNOWN, Findings, Section, number, times
from clear_strategies.bench.prototype import Prototype, started
from clear_strategies.bench.rasterizers import noise, usable
from clear_strategies.bench.rounds import Contender, Milliseconds, bar, interleaved, medians, milliseconds
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.conductor import Conductor
from clear_strategies.data.view import Photo, View
from clear_strategies.density import Density, DensitySettings
from clear_strategies.errors import DataError
from clear_strategies.field import GaussianField
from clear_strategies.fit import FitSettings, TrainState, cores, iterate
from clear_strategies.fused import fused_step
from clear_strategies.gco import GCO
from clear_strategies.ledger import Ledger
from clear_strategies.mip import MipFilter
from clear_strategies.objective import Objective
from clear_strategies.optim import Adam, LearningRates
from clear_strategies.p2g import P2G
from clear_strategies.schedules import LogLinear, WarmupDecay
from clear_strategies.strategy import Strategy
from clear_strategies.svs import SVS
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
_TOTAL, _REST = "total", "everything else"
_LR_ONLY: Final = "LR only"
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


class Training:
    """A run in its middle, t_a behind it: HR at full weight, dropout, evidence, correction and anchor are all on.

    The learning rates are 0: Adam does all its work and the scene stays what it is, turn after turn.
    """

    def __init__(self, workload: Workload, view: View, rasterizer: Rasterizer, conductor: Conductor) -> None:
        field = field_of(workload.splats)
        # Held from turning off after t_a, so that statistics are gathered; rounds of densification come too rarely.
        density = Density(DensitySettings(stop=10_000), len(field), extent=1.0, seed=0)
        rates = LearningRates(LogLinear(1e-30, 1e-30), *(0.0,) * 6, detail_decay=0.002)
        settings = FitSettings(degree_every=1)
        conductor.on_fit_start(1, 0)
        optimizer = Adam(field.raw(), rates, 1.0)
        self.state = TrainState(
            field, conductor, optimizer, density, settings, MipFilter(), (view,),
            t=SVS().anchor_start, fused=fused_step(conductor, optimizer),
        )  # fmt: skip
        self.state.refilter()
        self.rasterizer = rasterizer
        iterate(self.state, rasterizer)  # takes the anchor

    def __call__(self) -> Milliseconds:
        whole = Ledger()
        self.state.conductor.ledger = Ledger()
        with whole.stage(_TOTAL):
            iterate(self.state, self.rasterizer)
        stages = milliseconds(self.state.conductor.ledger)
        # What was skipped is no stage. "render LR" and "render LR + HR" are one.
        stages = {name.split()[0] if name.startswith("render") else name: ms for name, ms in stages.items() if ms > 0}
        total = milliseconds(whole)[_TOTAL]
        return {**stages, _REST: max(0.0, total - sum(stages.values())), _TOTAL: total}


def measure(request: Request, say: Callable[[str], None]) -> Findings:
    """A full iteration, one without HR, and the prototype's forward and backward, taking turns.

    Raises:
        DataError: a name is unknown, or the scene has no LR grid.
    """
    findings = Findings("iteration", torch.get_num_threads())

    def skip(line: str) -> None:
        say(line)
        findings.skipped.append(line)

    workload = scenes.load(request.scene, request.data)
    if isinstance(workload, str):
        raise DataError("--scene", request.scene, workload, "or take another scene")
    (backend,) = usable([request.backend or "auto"], "cpu", skip)
    rasterizer = rasterizers.load(backend, preset=request.preset, **SETTINGS)
    view = view_of(workload, rasterizer)
    without_hr = Objective(lambda_hr=WarmupDecay(peak=0.0, final=0.0))
    make = STRATEGIES[request.strategy]
    full = f"{request.strategy}, LR + HR"
    trainings = (
        Training(workload, view, rasterizer, Conductor(*make(), objective=Objective(), statistics_from=500)),
        Training(workload, view, rasterizer, Conductor(*make(), objective=without_hr)),
    )
    turns: dict[str, Contender] = dict(zip((full, _LR_ONLY), trainings, strict=True))
    with started(request.prototype, findings.threads) as peer:
        if isinstance(peer, str):
            skip(f"prototype: {peer}.")
        else:
            peer.scene(workload, noise(workload))
            turns[_PEER] = _plain(peer, PRESETS[request.preset])
        progress_bar = bar(len(turns) * (request.repeats + 1), request.strategy)
        with progress_bar as progress, cores(trainings[0].state, rasterizer):
            ms = interleaved(turns, request.repeats, progress=progress)
    size = f"LR {view.lr.camera.width}x{view.lr.camera.height} + HR {view.hr.camera.width}x{view.hr.camera.height}"
    title = (
        f"{request.strategy} on {workload.name}: {len(workload.splats):,} Gaussians, {size}, {backend} {request.preset}"
    )
    findings.sections = [_section(title, full, {name: medians(stages) for name, stages in ms.items()})]
    findings.raw = {
        "scene": workload.name, "strategy": request.strategy, "backend": backend, "preset": request.preset,
        "settings": SETTINGS, "ms": ms,
    }  # fmt: skip
    return findings


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
        return (image + _NOISE * torch.randn(image.shape, generator=generator)).clamp(0, 1)

    lr = Photo(camera.scaled(1 / factor), noisy(images.downsample(clean, factor)))
    return View("bench", lr, Photo(camera, noisy(clean)), reference="render plus noise")


def _plain(prototype: Prototype, cuts: Mapping[str, float]) -> Contender:
    def turn() -> Milliseconds:
        stages = {"forward": prototype.forward(cuts), "backward K=1": prototype.backward(1)}
        return {**stages, _TOTAL: sum(stages.values())}

    return turn


def _section(title: str, full: str, median: Mapping[str, Mapping[str, float]]) -> Section:
    ours = [name for name in (full, _LR_ONLY) if name in median]
    stages = [s for s in dict.fromkeys(stage for name in ours for stage in median[name]) if s not in (_REST, _TOTAL)]
    stages += [_REST, _TOTAL]
    columns = {"stage": stages}
    for name in ours:
        columns[f"{name}, ms"] = [number(median[name][s]) if s in median[name] else UNKNOWN for s in stages]
    total = median[full][_TOTAL]
    notes = [
        f"Medians by stage, so they need not add up. 10,000 such iterations take {total * 10 / 60:.0f} minutes. An "
        f"iteration without the HR scale costs {times(median[_LR_ONLY][_TOTAL] / total)} of a full one."
    ]
    if _PEER in median:
        plain = median[_PEER][_TOTAL]
        notes.append(
            f"{_PEER[0].upper()}{_PEER[1:]}, in the same turns: {number(plain)} ms; the full iteration is "
            f"{times(total / plain)} that."
        )
    return Section(title, columns, notes)
