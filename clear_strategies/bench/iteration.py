"""Time and error of one training iteration of CLEAR, stage by stage, and the time without L_HF and without HR.

The truth is the same iteration in float64 by the readable path, at the same cut-offs, whose stages get what the measured ones
were given. Compared is what a stage hands on: images, their cotangents, the gradients of the Gaussians, and the merged gradient,
as Adam's first moment holds it after a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import torch
from torch import Tensor

import rasterizers
from clear_strategies.bench import scenes
from clear_strategies.bench.accuracy import affordable, in_float64, relative, truth_backend
from clear_strategies.bench.rasterizers import require_device, usable
from clear_strategies.bench.results import Results
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.bench.timing import interleaved, medians, milliseconds
from clear_strategies.core import images
from clear_strategies.core.view import Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.density.adaptive import Density, DensitySettings
from clear_strategies.errors import DataError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.objective import Objective
from clear_strategies.schedules import LogLinear, WarmupDecay
from clear_strategies.strategies.gco import GCO
from clear_strategies.strategies.p2g import P2G
from clear_strategies.strategies.svs import SVS
from clear_strategies.training.compiled_step import FusedMode, compiled_step_for
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import iterate, kernel_threads
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers.interface import PRESETS, Camera, Rasterizer, Rendering, SplatGradients, Splats

FROZEN: Final = LearningRates(LogLinear(1e-30, 1e-30), *(0.0,) * 6, detail_decay=0.002)
"""Adam does all its work, and the scene stays the same from turn to turn."""

TOTAL, REST = "total", "everything else"
FULL, WITHOUT_HF, LR_ONLY = "lr_and_hr", "without_l_hf", "lr_only"
OBJECTIVES: Final = {
    FULL: Objective(),
    WITHOUT_HF: Objective(lambda_hf=0.0),
    LR_ONLY: Objective(lambda_hr=WarmupDecay(peak=0.0, final=0.0)),
}
_PER_TURN: Final = {"cpu": 1, "cuda": 16}  # on CUDA the host launches an iteration while the last one is computed
_NOISE: Final = 0.02  # standard deviation in the photos


Stages = dict[str, dict[str, Tensor]]
"""What the stages of an iteration hand on, by the stage and by name."""


class Training:
    """CLEAR after densification: HR at full weight, dropout, correction and evidence are all on."""

    def __init__(
        self,
        workload: Workload,
        view: View,
        rasterizer: Rasterizer,
        objective: Objective,
        *,
        dropout: bool = True,
        fused: FusedMode = "auto",
    ) -> None:
        field, device = field_of(workload.splats), workload.splats.means.device
        conductor = Conductor(GCO(), P2G(), *([SVS()] if dropout else []), objective=objective)
        # Statistics are gathered, although no round of densification follows.
        density = Density(DensitySettings(stop=10_000), len(field), extent=1.0, seed=0, device=device)
        conductor.on_fit_start(1, 0, device)
        optimizer = Adam(field.raw(), FROZEN, 1.0)
        self.state = TrainState(
            field, conductor, optimizer, density, FitSettings(degree_every=1), MipFilter(), (view,),
            t=SVS().anchor_start, compiled_step=compiled_step_for(conductor, optimizer, fused),
        )  # fmt: skip
        self.state.refilter()
        self.rasterizer = rasterizer

    def __call__(self) -> dict[str, float]:
        device = self.state.field.means.device
        iterations = _PER_TURN[device.type]
        whole, self.state.conductor.work_log = WorkLog(device), WorkLog(device)
        with whole.stage(TOTAL):
            for _ in range(iterations):
                iterate(self.state, self.rasterizer)
        stages: dict[str, float] = {}
        for name, ms in milliseconds(self.state.conductor.work_log).items():
            stage = "render" if name.startswith("render") else name  # "render LR" and "render LR + HR"
            if ms > 0:
                stages[stage] = stages.get(stage, 0.0) + ms / iterations
        total = milliseconds(whole)[TOTAL] / iterations
        return {**stages, REST: max(0.0, total - sum(stages.values())), TOTAL: total}


def measure(
    results: Results,
    *,
    scene: str,
    backend: str | None = None,
    preset: str = "fast",
    repeats: int,
    device: str = "cpu",
    data: Path | None = None,
) -> None:
    """Measure a full iteration, one without L_HF and one without HR, in turns.

    Args:
        backend: None: the fastest that runs here.

    Raises:
        DataError: a name is unknown, the scene has no LR grid, or there is no such device.
    """
    require_device(device)
    workload = scenes.load(scene, data).to(device)
    (backend,) = usable([backend or rasterizers.fastest(device)], device, results.note)
    rasterizer = rasterizers.load(backend, preset=preset, **SETTINGS)
    view = view_of(workload, rasterizer)
    trainings = {name: Training(workload, view, rasterizer, objective) for name, objective in OBJECTIVES.items()}
    with kernel_threads(trainings[FULL].state, rasterizer):
        turns = interleaved(trainings, repeats, device=device, label=workload.name)
    table = medians(turns).T.add_suffix("_ms")
    order = [stage for stage in table.index if stage not in (REST, TOTAL)] + [REST, TOTAL]
    table = table.loc[order].rename_axis("stage").reset_index()
    truth = truth_backend()
    if affordable(truth, workload, "errors", results.note):
        table["error"] = table["stage"].map(
            errors(workload, view, rasterizer, in_float64(truth, workload, PRESETS[preset]))
        )
    results.tables |= {"iteration": table, "iteration_turns": turns}
    lr, hr = view.lr.camera, view.hr.camera
    results.note(
        f"{workload.name}: {len(workload.splats):,} Gaussians, LR {lr.width}x{lr.height} and HR {hr.width}x{hr.height}, "
        f"{backend} {preset}. Medians by stage, so they need not add up to the total."
    )


def errors(
    workload: Workload, view: View, rasterizer: Rasterizer, in_float64: tuple[Rasterizer, Workload]
) -> dict[str, float]:
    """The largest relative L2 error of a stage's images, or of the attributes of its gradients."""
    truth, wide = in_float64
    lr, hr = (replace(photo, image=photo.image.to(wide.splats.means)) for photo in (view.lr, view.hr))
    found = _handed_on(workload, view, _Watched(rasterizer), "auto")
    expected = _handed_on(wide, replace(view, lr=lr, hr=hr), _Watched(truth, found), "off")
    return {
        # The basis is no gradient, and has any value where a Gaussian is not seen.
        stage: max(relative(x, expected[stage][name]) for name, x in tensors.items() if name != "basis")
        for stage, tensors in found.items()
    }


def _handed_on(workload: Workload, view: View, watched: _Watched, fused: FusedMode) -> Stages:
    """What the stages of an iteration hand on. Nothing is dropped: a device draws masks of its own."""
    state = Training(workload, view, watched, Objective(), dropout=False, fused=fused).state
    iterate(state, watched)
    return watched.seen | dict.fromkeys(("per-Gaussian pass", "optimizer"), state.optimizer.first)


class _Watched:
    """A rasterizer; `seen` keeps what it hands on, and what the losses do.

    Args:
        given: what the stages of another iteration handed on; each stage of this one gets it in place of its own.
    """

    def __init__(self, rasterizer: Rasterizer, given: Stages | None = None) -> None:
        self._rasterizer, self.traits, self._given = rasterizer, rasterizer.traits, given
        self.seen: Stages = {"render": {}}

    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Rendering:
        return self._rasterizer(splats, camera, depth=depth)

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], *, depth: Sequence[bool] | None = None
    ) -> list[Rendering]:
        lr, hr = self._rasterizer.render_scales(jobs, depth=depth)
        return [self._watched(lr, "LR"), self._watched(hr, "HR")]

    def _watched(self, r: Rendering, scale: str) -> Any:
        self.seen["render"][scale] = image = r.image
        if self._given is not None:
            image = self._given["render"][scale].to(image)

        def vjp(cotangents: Tensor) -> SplatGradients:
            self.seen[f"losses {scale}"] = {"cotangents": cotangents.clone()}
            if self._given is not None:
                cotangents = self._given[f"losses {scale}"]["cotangents"].to(cotangents)
            g = r.vjp(cotangents)
            self.seen[f"backward {scale}"] = {f.name: getattr(g, f.name).clone() for f in fields(g)}
            if self._given is None:
                return g
            return SplatGradients(**{name: x.to(image) for name, x in self._given[f"backward {scale}"].items()})

        return SimpleNamespace(image=image, alpha=r.alpha, depth=r.depth, means2d=r.means2d, visible=r.visible, vjp=vjp)


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
    """One view whose photos are a render plus noise; a DataError where no LR grid divides the image."""
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
