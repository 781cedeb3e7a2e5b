"""One job, from its configuration to its outputs."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from clear_strategies import files, viewing
from clear_strategies.compose import tree
from clear_strategies.data.prepare import save_lr
from clear_strategies.data.scene import Scene
from clear_strategies.jobs import device, resume
from clear_strategies.jobs import scene as scenes
from clear_strategies.jobs.lock import hold
from clear_strategies.jobs.settings import JobSettings, settings_of
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import plan, results, score_table
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.outputs.progress import progress_bar
from clear_strategies.schedules import scaled
from clear_strategies.training import memory, signals
from clear_strategies.training.checkpoint import CHECKPOINTS
from clear_strategies.training.loop import fit
from clear_strategies.training.state import TrainState
from clear_strategies.viewing.cameras import write_cameras
from clear_strategies.viewing.look import Painter

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Place:
    """The scene and the machine of a job.

    Args:
        scene: on the CPU. device_scene: the same scene on the device of `drawing`.
    """

    scene: Scene
    device_scene: Scene
    drawing: device.Drawing


@dataclass(frozen=True, slots=True)
class _Training:
    """The training of a job.

    Args:
        compared: the configuration from `resume.comparable`, which a resumed run must have in common.
        folder: for its files.
        overrides: of the command line, for the report; None: unknown.
        claim: called once `folder` is this run's, see `run`.
    """

    settings: JobSettings
    conductor: Conductor
    compared: Mapping[str, Any]
    folder: Path
    overrides: Sequence[str] | None
    claim: Callable[[], None]

    @property
    def chosen(self) -> plan.Chosen:
        return plan.Chosen(self.settings.method, list(self.settings.strategies), self.overrides)

    def start(self, place: _Place) -> TrainState:
        """The state that training starts from: the initial one, or the checkpoint that `fit.resume` names."""
        settings, stretch = self.settings, self.settings.fit.stretch
        state = TrainState.start(
            place.device_scene,
            self.conductor,
            settings=scaled(settings.fit, stretch),
            density=scaled(settings.density, stretch),
            rates=scaled(settings.optim, stretch).of_run(settings.fit.iterations),
            mip=scaled(settings.mip, stretch),
            near=place.drawing.near,
        )
        resume.resume(state, place.scene, settings.fit.resume, self.folder, self.compared)
        return state


def run(
    config: DictConfig, folder: Path, overrides: Sequence[str] | None = None, claim: Callable[[], None] = lambda: None
) -> float | None:
    """Run one job and write its files into `folder`.

    Every setting is checked before the folder is locked and before data is read.

    Args:
        overrides: that the configuration was composed of, which the report names the run by.
        claim: called, perhaps twice, once the folder is this run's: at once where there was no run, else when nothing can refuse
            this one any more. Nothing is written there before, except the lock.

    Returns:
        The mean PSNR of the test views, dB, which a sweeper may optimize; of the training views if there are no test views.
        None if there is no score, e.g. because `data.save_lr` ends the job before training.

    Raises:
        SettingError, StrategyConflict: the configuration cannot be used.
        DataError: a file cannot be used, another job is at work in the folder, or the folder holds a run of another
            configuration.
    """
    values = tree(config)
    settings = settings_of(values)
    fit = settings.fit
    if fit.viewer:
        viewing.require_viewer()
    training = _Training(settings, settings.conductor(fit.stretch), resume.comparable(values), folder, overrides, claim)
    drawing = device.drawing(settings.rasterizer, fit.device)
    with hold(folder), signals.interrupted("before training began"):
        if not resume.begun(folder):
            claim()
        return _run(training, drawing)


def _in_sweep() -> bool:
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def _run(training: _Training, drawing: device.Drawing) -> float | None:
    settings = training.settings
    threads, reason = device.threads(settings.fit.threads)
    torch.set_num_threads(threads)
    load = functools.partial(scenes.load, settings.data, settings.prior, settings.fit.seed, training.conductor.prior)
    if settings.fit.resume == resume.AUTO:
        finished = resume.finished(training.folder, training.compared, load)
        if finished is not None:
            score = finished.shown.mean.get("ours")
            return None if score is None else score.psnr
    scene = load()
    few = scene.notes.get(scenes.FEW_PLACED)
    if few:
        _log.warning("%s.", few)
    if settings.data.save_lr is not None:
        save_lr(scene, Path(settings.data.save_lr))
        return None
    device.log_choice(settings.rasterizer, drawing)
    drawing = drawing.over(scene.background).among(scene.cloud.means)
    place = _Place(scene, scene.to(drawing.device), drawing)
    state = training.start(place)
    training.claim()
    files.sweep(training.folder)
    _announce(training, state, place, f"{threads} ({reason})")
    # In a sweep the console shows one line per job; the rest is in run.log.
    level = logging.DEBUG if _in_sweep() else logging.INFO
    results.remove_earlier(training.folder, all_files=state.t == 1)
    evaluation, seconds = _train(training, state, place)
    _log.log(level, "%s", score_table.describe(training.folder, evaluation, seconds))
    if _in_sweep():
        _log.info("%s", score_table.describe_job(HydraConfig.get().job.num, training.folder, evaluation, seconds))
    if few:
        _log.warning("%s.", few)
    mean = evaluation.mean("test") or evaluation.mean("train")
    return None if mean is None else mean.psnr


def _announce(training: _Training, state: TrainState, place: _Place, threads: str) -> None:
    """Log the plan, and what was set in vain. A SettingError if the run does not fit into memory."""
    memory.release()
    machine = {
        "rasterizer": f"{place.drawing.name}, kernel {place.drawing.kernel} px²",
        "threads": threads,
        "memory": memory.require(state, training.settings.fit.memory),
    }
    described = plan.describe(place.scene, state, training.chosen, machine)
    _log.log(logging.DEBUG if _in_sweep() else logging.INFO, "%s", described.short)
    _log.debug("%s", described.details)
    idle = [override for override in training.overrides or () if override.lstrip("+").startswith("density.")]
    if idle and not isinstance(state.density.settings, type(training.settings.density)):
        _log.warning("%s has no effect: %s densifies in place of it.", ", ".join(idle), state.density.name)


@contextmanager
def _watched(training: _Training, state: TrainState, place: _Place) -> Iterator[Callable[[], None] | None]:
    """Open the viewer if `fit.viewer` asks for it, and yield a function to call after each iteration."""
    if not training.settings.fit.viewer:
        yield None
        return
    from clear_strategies.viewing.server import watched

    painter, cameras = Painter(state.field, place.drawing.make), [view.hr.camera for view in place.scene.train]
    tell = functools.partial(_log.info, "look while it trains: %s")
    with watched(painter, cameras, f"{place.scene.name} · {training.chosen.title}", tell) as turn:
        yield lambda: turn(state.t - 1)


def _train(training: _Training, state: TrainState, place: _Place) -> tuple[Evaluation, float]:
    """Train to the end and write the files; return the scores and the seconds of training."""
    settings, rasterizer, alone = training.settings, place.drawing.rasterizer, device.jobs_at_once() == 1
    began = time.perf_counter() - state.seconds  # with what a resumed run took before
    with signals.interrupted("before the run was finished", lambda: resume.newest(training.folder)):
        write_cameras(training.folder, place.scene)
        watched = _watched(training, state, place)
        with watched as after_step, progress_bar(state, after_step, training.chosen.title, shown=alone) as progress:
            folder = training.folder / CHECKPOINTS
            fit(state, place.device_scene, rasterizer, checkpoints=folder, config=training.compared, progress=progress)
        seconds = time.perf_counter() - began
        training.conductor.on_fit_end()  # its memory is for the results
        state.second = state.other = None
        memory.release()
        evaluation = results.write_results(
            training.folder, place.scene, state, rasterizer, training.chosen,
            backend=place.drawing.name, down=settings.data.views.downsample,
            painter=Painter(state.field, place.drawing.make), seconds=seconds, config=training.compared,
            pictures=results.Pictures(settings.fit.map_views, settings.fit.video, settings.fit.page),
            antialiased=place.drawing.antialiased,
        )  # fmt: skip
    return evaluation, seconds
