"""One job, from its configuration to its outputs."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from clear_strategies.compose import ConductorSettings, tree
from clear_strategies.data.prepare import save_lr
from clear_strategies.density.base import DensifierSettings
from clear_strategies.errors import SettingError
from clear_strategies.jobs import device, resume, scene
from clear_strategies.jobs.device import Device, RasterizerSettings
from clear_strategies.jobs.lock import hold
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import plan, results
from clear_strategies.outputs.progress import progress_bar
from clear_strategies.schedules import scaled
from clear_strategies.settings import build
from clear_strategies.training.loop import fit
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.skips import Skips
from clear_strategies.training.state import TrainState

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSettings(FitSettings):
    """Settings of a run besides those of its training.

    Args:
        map_views: number of training views with maps of reliability and correction in maps/; 0: none.
        resume: a run's folder or one of its checkpoints: continue from there, bit for bit. auto: in the run's own folder,
            train nothing if the run is finished, else continue from its newest checkpoint, else start.
        device: cpu or cuda, of field, views and optimizer; None: cuda where torch finds it and the rasterizer draws there,
            else cpu. A run may be resumed on another device; its bits then differ.
        threads: of torch and the kernels; None: all cores, divided by the jobs that run at once (joblib, Slurm).
    """

    map_views: int = 3
    resume: str | None = None
    device: Device | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        FitSettings.__post_init__(self)
        if self.map_views < 0:
            raise SettingError(f"map_views must be at least 0, got {self.map_views}. 0 writes no maps.")
        if self.threads is not None and self.threads < 1:
            raise SettingError(f"threads must be at least 1, got {self.threads}. null takes all cores.")


@dataclass(frozen=True, slots=True, kw_only=True)
class JobSettings(ConductorSettings):
    """The whole of conf/config.yaml, as objects.

    Args:
        method: which baseline of the papers' tables this is, for the plan and the tables; set by +method=NAME.
    """

    rasterizer: RasterizerSettings | functools.partial[Any]
    prior: scene.PriorSettings
    data: scene.DataSettings
    density: DensifierSettings
    optim: LearningRates
    skips: Skips
    fit: RunSettings = field(default_factory=RunSettings)
    mip: MipFilter = field(default_factory=MipFilter)
    method: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.prior, functools.partial):
            self.prior(truth={})  # it waits for the photos; its own settings are refused now
        scene.require_factor(self.prior, self.data.views.sr_scale)


def settings_of(values: Mapping[str, Any]) -> JobSettings:
    """The settings of a resolved configuration, see `compose.tree`.

    Raises:
        SettingError: one cannot be used; the message begins with its key.
    """
    settings: JobSettings = build({**values, "rasterizer": device.rasterizer_node(values["rasterizer"])})
    return settings


def run(config: DictConfig, folder: Path, watch: Callable[[], None] | None = None) -> float | None:
    """Train one job into `folder`, and return the mean PSNR of the test views, which a sweeper may optimize.

    Every setting is checked before the folder is locked and before data is read. `watch` is called after each iteration.

    Raises:
        SettingError, StrategyConflict: the configuration cannot be used.
        DataError: a file cannot; or another job is at work in the folder, or wrote another configuration there.
    """
    values = tree(config)
    settings = settings_of(values)
    conductor = settings.conductor(settings.fit.stretch)
    drawing = device.drawing(settings.rasterizer, settings.fit.device)
    with hold(folder):
        return _run(settings, conductor, drawing, resume.comparable(values), folder, watch)


def _run(
    settings: JobSettings,
    conductor: Conductor,
    drawing: device.Drawing,
    compared: Mapping[str, Any],
    folder: Path,
    watch: Callable[[], None] | None,
) -> float | None:
    if settings.fit.resume == resume.AUTO and (finished := resume.finished(folder, compared)) is not None:
        return finished[0]
    threads, why = device.threads(settings.fit.threads)
    torch.set_num_threads(threads)
    loaded = scene.load(settings.data, settings.prior, settings.fit.seed)
    if settings.data.save_lr is not None:
        save_lr(loaded, Path(settings.data.save_lr))
        return None
    device.log_choice(settings.rasterizer)
    drawing, there = drawing.over(loaded.background), loaded.to(drawing.device)
    stretch = settings.fit.stretch
    state = TrainState.start(
        there,
        conductor,
        settings=scaled(settings.fit, stretch),
        density=scaled(settings.density, stretch),
        rates=scaled(settings.optim, stretch),
        mip=scaled(settings.mip, stretch),
        skips=scaled(settings.skips, stretch),
    )
    resume.resume(state, settings.fit.resume, folder, compared)
    chosen = plan.Chosen(settings.method, list(settings.strategies))
    drawn = f"{drawing.name}, kernel {drawing.kernel} px²"
    _log.info("%s", plan.describe(loaded, state, chosen, rasterizer=drawn, threads=f"{threads} ({why})"))
    metrics = folder / "metrics.json"
    if metrics.exists():
        _log.warning("%s: of an earlier run; removed, because its presence says that a run is finished.", metrics)
        metrics.unlink()
    began = time.perf_counter() - state.seconds  # with what a resumed run took before
    with progress_bar(state, watch) as progress:
        fit(
            state, there, drawing.rasterizer, checkpoints=folder / "checkpoints", config=compared, progress=progress
        )  # fmt: skip
    return results.write_results(
        folder,
        loaded,
        state,
        drawing.rasterizer,
        chosen,
        backend=drawing.name,
        down=settings.data.views.downsample,
        map_views=settings.fit.map_views,
        seconds=time.perf_counter() - began,
        config=compared,
    )
