"""Time and error of one training iteration of CLEAR, stage by stage, and the time without L_HF, without HR and replayed.

The truth is the same iteration in float64 by the readable path, at the same cut-offs; each of its stages gets the inputs of the
measured stage. The outputs of the stages are compared: images, their cotangents, the gradients of the Gaussians, and the merged
gradient, from Adam's first moment after a step.
"""

from __future__ import annotations

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any, Final

import torch
from torch import Tensor

import rasterizers
from clear_strategies.bench import scenes
from clear_strategies.bench.rasterizers import affordable, in_float64, relative, require_device, truth_backend, usable
from clear_strategies.bench.results import Results, interleaved, medians, milliseconds, queued
from clear_strategies.bench.scenes import SETTINGS, Workload
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
from clear_strategies.training.compiled_step import FusedMode, compiled_step_for
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import iterate, kernel_threads
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.replayed_iteration import replays_for
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers.interface import PRESETS, Camera, Rasterizer, Recordable, Rendering, SplatGradients, Splats, summed_vjp

FROZEN: Final = LearningRates(LogLinear(1e-30, 1e-30), *(0.0,) * 6, detail_decay=0.002)
"""Adam does all its work, but the scene stays the same from turn to turn."""

TOTAL, REST = "total", "everything else"
OBJECTIVES: Final = {
    "lr_and_hr": Objective(),
    "without_l_hf": Objective(lambda_hf=0.0),
    "lr_only": Objective(lambda_hr=WarmupDecay(peak=0.0, final=0.0)),
}
_PER_TURN: Final = {"cpu": 1, "cuda": 16}  # iterations; on CUDA one is launched while the one before is computed
_PRESET: Final = "fast"
_NOISE: Final = 0.02  # standard deviation in the photos


Outputs = dict[str, dict[str, Tensor]]
"""Stage of an iteration -> name -> tensor."""


class Training:
    """Training by CLEAR after densification, with HR at full weight, dropout, correction and evidence. A call times a turn."""

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
        # Statistics are accumulated, although no densification follows.
        density = Density(DensitySettings(stop=10_000), field, (view,), seed=0)
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
    """Measure a full iteration, one without L_HF, one without HR and, where there are recordings, a replayed one, in turns.

    Args:
        backend: None: the fastest that runs here.

    Raises:
        DataError: a name is unknown, or there is no such device.
    """
    require_device(device)
    workload = scenes.load(scene).to(device)
    (backend,) = usable([backend or rasterizers.fastest(device)], device, results.note)
    rasterizer = rasterizers.load(backend, preset=_PRESET, **SETTINGS)
    view = view_of(workload, rasterizer)
    trainings = {name: Training(workload, view, rasterizer, objective) for name, objective in OBJECTIVES.items()}
    if device == "cuda" and isinstance(rasterizer, Recordable):
        replayed = trainings["replayed"] = Training(workload, view, rasterizer, Objective())
        replayed.state.replays = replays_for(replayed.state, rasterizer)
    with kernel_threads(trainings["lr_and_hr"].state, rasterizer):
        turns = interleaved(trainings, repeats, device=device, label=workload.name)
    table = medians(turns).T.add_suffix("_ms")
    order = [stage for stage in table.index if stage not in (REST, TOTAL)] + [REST, TOTAL]
    table = table.loc[order].rename_axis("stage").reset_index()
    if affordable(truth_backend(), workload, "errors", results.note):
        table["error"] = table["stage"].map(errors(workload, view, rasterizer))
    results.tables |= {"iteration": table, "iteration_turns": turns}
    if "replayed" in trainings and "replayed" not in set(table["stage"]):
        results.note("No iteration was replayed, and those called so were live: the log says why.")
    lr, hr = view.lr.camera, view.hr.camera
    results.note(
        f"{workload.name}: {len(workload.splats):,} Gaussians, LR {lr.width}x{lr.height} and HR {hr.width}x{hr.height}, "
        f"{backend} {_PRESET}. Medians by stage, so they need not add up to the total."
    )


def errors(workload: Workload, view: View, rasterizer: Rasterizer) -> dict[str, float]:
    """The largest relative L2 error of a stage's images, or of the attributes of its gradients."""
    truth, wide = in_float64(truth_backend(), workload, PRESETS[_PRESET])
    lr, hr = (replace(photo, image=photo.image.to(wide.splats.means)) for photo in (view.lr, view.hr))
    measured = _outputs(workload, view, rasterizer, "auto")
    expected = _outputs(wide, replace(view, lr=lr, hr=hr), truth, "off", given=measured)
    return {
        # The SH basis is no gradient, and has arbitrary values for Gaussians that are not seen.
        stage: max(relative(x, expected[stage][name]) for name, x in tensors.items() if name != "basis")
        for stage, tensors in measured.items()
    }


def _outputs(
    workload: Workload, view: View, rasterizer: Rasterizer, fused: FusedMode, given: Outputs | None = None
) -> Outputs:
    """The outputs of the stages of an iteration without dropout, whose masks differ between devices.

    Args:
        given: the outputs of another iteration; each stage gets them as inputs in place of this iteration's own.
    """
    outputs: Outputs = {"render": {}}

    def watched(r: Rendering, scale: str) -> Any:
        outputs["render"][scale] = r.image
        image = r.image if given is None else given["render"][scale].to(r.image)

        def vjp(cotangents: Tensor, weight: Tensor | None = None) -> SplatGradients:
            outputs[f"losses {scale}"] = {"cotangents": cotangents.clone()}
            if weight is not None:
                outputs["evidence"] = {"weight": weight.clone()}
            if given is not None:
                cotangents = given[f"losses {scale}"]["cotangents"].to(image)
                weight = None if weight is None else given["evidence"]["weight"].to(weight)
            g = summed_vjp(r, cotangents, weight)
            outputs[f"backward {scale}"] = {
                f.name: x.clone() for f in fields(g) if (x := getattr(g, f.name)) is not None
            }
            if given is None:
                return g
            return SplatGradients(**{name: x.to(image) for name, x in given[f"backward {scale}"].items()})

        kept = {name: getattr(r, name) for name in ("alpha", "depth", "means2d", "visible")}
        return SimpleNamespace(**kept, image=image, vjp=vjp, summed_vjp=vjp)

    def render_scales(jobs: Any, **options: Any) -> list[Any]:
        return list(map(watched, rasterizer.render_scales(jobs, **options), ("LR", "HR")))

    watching = _Rasterizer(traits=rasterizer.traits, render_scales=render_scales)
    state = Training(workload, view, watching, Objective(), dropout=False, fused=fused).state
    iterate(state, watching)
    return outputs | dict.fromkeys(("per-Gaussian pass", "optimizer"), state.optimizer.first)


class _Rasterizer(SimpleNamespace):
    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Any:
        return self.render_scales([(splats, camera)], depth=[depth])[0]


def field_of(splats: Splats) -> GaussianField:
    """The field that renders as these splats without the 3D filter."""
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
    """A view whose photos are a render plus noise."""
    factor, camera = workload.lr_factor, workload.camera
    clean = rasterizer(workload.splats, camera).image
    generator = torch.Generator().manual_seed(1)

    def noisy(image: Tensor) -> Tensor:
        return (image + _NOISE * torch.randn(image.shape, generator=generator).to(image.device)).clamp(0, 1)

    lr = Photo(camera.scaled(1 / factor), noisy(images.downsample(clean, factor)))
    return View("bench", lr, Photo(camera, noisy(clean)), sr_source="render plus noise")
