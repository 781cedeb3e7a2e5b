"""The time of one training iteration of CLEAR, stage by stage, without L_HF and without HR."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

import rasterizers
from clear_strategies.bench import scenes
from clear_strategies.bench.rasterizers import require_device, usable
from clear_strategies.bench.results import Results
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.bench.timing import interleaved, medians, milliseconds, queued
from clear_strategies.core import images
from clear_strategies.core.view import Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.density.adaptive import Density, DensitySettings
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.objective import Objective
from clear_strategies.schedules import LogLinear, WarmupDecay
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
from rasterizers.interface import Rasterizer, Splats

FROZEN: Final = LearningRates(LogLinear(1e-30, 1e-30), *(0.0,) * 6, detail_decay=0.002)
"""Adam does all its work, and the scene stays the same from turn to turn."""

TOTAL, REST = "total", "everything else"
OBJECTIVES: Final = {
    "lr_and_hr": Objective(),
    "without_l_hf": Objective(lambda_hf=0.0),
    "lr_only": Objective(lambda_hr=WarmupDecay(peak=0.0, final=0.0)),
}
_PER_TURN: Final = {"cpu": 1, "cuda": 16}  # on CUDA the host launches an iteration while the last one is computed
_PRESET: Final = "fast"
_NOISE: Final = 0.02  # standard deviation in the photos


class Training:
    """CLEAR after densification: HR at full weight, dropout, correction and evidence are all on."""

    def __init__(self, workload: Workload, view: View, rasterizer: Rasterizer, objective: Objective) -> None:
        field, device = field_of(workload.splats), workload.splats.means.device
        conductor = Conductor(GCO(), P2G(), SVS(), objective=objective)
        # Statistics are gathered, although no round of densification follows.
        density = Density(DensitySettings(stop=10_000), len(field), extent=1.0, seed=0, device=device)
        conductor.on_fit_start(1, 0, device)
        optimizer = Adam(field.raw(), FROZEN, 1.0)
        self.state = TrainState(
            field, conductor, optimizer, density, FitSettings(degree_every=1), MipFilter(), (view,),
            t=SVS().anchor_start, compiled_step=compiled_step_for(conductor, optimizer),
        )  # fmt: skip
        self.state.refilter()
        self.rasterizer = rasterizer

    def __call__(self) -> dict[str, float]:
        device = self.state.field.means.device
        iterations = _PER_TURN[device.type]
        whole, self.state.conductor.work_log = WorkLog(device), WorkLog(device)
        with queued(whole, TOTAL):
            for _ in range(iterations):
                iterate(self.state, self.rasterizer)
        stages: dict[str, float] = {}
        for name, ms in milliseconds(self.state.conductor.work_log).items():
            stage = "render" if name.startswith("render") else name  # "render LR" and "render LR + HR"
            if ms > 0:
                stages[stage] = stages.get(stage, 0.0) + ms / iterations
        total = milliseconds(whole)[TOTAL] / iterations
        return {**stages, REST: max(0.0, total - sum(stages.values())), TOTAL: total}


def measure(results: Results, *, scene: str, backend: str | None, repeats: int, device: str) -> None:
    """Measure a full iteration, one without L_HF and one without HR, in turns.

    Args:
        backend: None: the fastest that runs here.
    """
    require_device(device)
    workload = scenes.load(scene).to(device)
    (backend,) = usable([backend or rasterizers.fastest(device)], device, results.note)
    rasterizer = rasterizers.load(backend, preset=_PRESET, **SETTINGS)
    view = view_of(workload, rasterizer)
    trainings = {name: Training(workload, view, rasterizer, objective) for name, objective in OBJECTIVES.items()}
    with kernel_threads(trainings["lr_and_hr"].state, rasterizer):
        turns = interleaved(trainings, repeats, device=device, label=workload.name)
    table = medians(turns).T.add_suffix("_ms")
    order = [stage for stage in table.index if stage not in (REST, TOTAL)] + [REST, TOTAL]
    table = table.loc[order].rename_axis("stage").reset_index()
    results.tables |= {"iteration": table, "iteration_turns": turns}
    lr, hr = view.lr.camera, view.hr.camera
    results.note(
        f"{workload.name}: {len(workload.splats):,} Gaussians, LR {lr.width}x{lr.height} and HR {hr.width}x{hr.height}, "
        f"{backend} {_PRESET}. Medians by stage, so they need not add up to the total."
    )


def field_of(splats: Splats) -> GaussianField:
    """The field that draws these splats when the 3D filter is off."""
    eps = torch.finfo(torch.float32).eps
    offset = splats.rgb_offset
    parameters: dict[str, Tensor] = {
        "means": splats.means, "quats": splats.quats, "scales": splats.scales.log(),
        "opacities": torch.logit(splats.opacities.clamp(eps, 1 - eps)), "sh0": splats.sh0, "shN": splats.shN,
        "detail": offset if offset is not None else torch.zeros_like(splats.means),
    }  # fmt: skip
    field = GaussianField(parameters)
    field.degree = field.max_degree
    return field


def view_of(workload: Workload, rasterizer: Rasterizer) -> View:
    """One view whose photos are a render plus noise."""
    factor, camera = workload.lr_factor, workload.camera
    clean = rasterizer(workload.splats, camera).image
    generator = torch.Generator().manual_seed(1)

    def noisy(image: Tensor) -> Tensor:
        return (image + _NOISE * torch.randn(image.shape, generator=generator).to(image.device)).clamp(0, 1)

    lr = Photo(camera.scaled(1 / factor), noisy(images.downsample(clean, factor)))
    return View("bench", lr, Photo(camera, noisy(clean)), sr_source="render plus noise")
