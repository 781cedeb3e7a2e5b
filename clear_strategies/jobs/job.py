"""One job, from its configuration to its outputs."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from clear_strategies import files, signals
from clear_strategies.compose import tree
from clear_strategies.core.images import to_bytes
from clear_strategies.data.prepare import save_lr
from clear_strategies.data.scene import Scene
from clear_strategies.errors import DataError
from clear_strategies.jobs import device, exit_codes, resume
from clear_strategies.jobs import scene as scenes
from clear_strategies.jobs.settings import JobSettings, settings_of
from clear_strategies.jobs.sweep import in_sweep, require_paths
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import metrics, plan, results
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.schedules import scaled
from clear_strategies.training import memory
from clear_strategies.training.checkpoint import CHECKPOINTS
from clear_strategies.training.loop import fit
from clear_strategies.training.state import TrainState
from clear_strategies.viewing.cameras import write_cameras
from clear_strategies.viewing.look import Painter

_log = logging.getLogger(__name__)


def run(
    config: DictConfig, folder: Path, overrides: Sequence[str] | None = None, claim: Callable[[], None] = lambda: None
) -> float | None:
    """Run one job and write its files into `folder`.

    Every setting is checked before the folder is locked and before data is read.

    Args:
        overrides: of the command line, from which the report makes the run's name.
        claim: called, perhaps twice, once the folder is this run's: at once if it had no run, else when all checks of this one
            are done. Before, only the lock is written there.

    Returns:
        The mean PSNR of the test views, dB, which a sweeper may optimize; of the training views if there are no test views.
        None if there is no score, e.g. because `data.save_lr` ends the job before training.

    Raises:
        SettingError, StrategyConflict: the configuration cannot be used.
        DataError: a file cannot be used, another job runs in the folder, or the folder has a run that is neither resumed nor to
            be overwritten, or that has another configuration.
    """
    values = tree(config)
    settings = settings_of(values)
    if settings.fit.viewer:
        exit_codes.require("view")
    conductor = settings.conductor(settings.fit.stretch)
    ready = device.load_rasterizer(settings.rasterizer, settings.fit.device)
    with files.hold(folder), signals.interrupted("before training began"):
        begun = resume.begun(folder)
        if begun and settings.fit.resume is None and not settings.fit.overwrite and settings.data.save_lr is None:
            remedy = "take another folder, go on with fit.resume=auto, or replace it with fit.overwrite=true"
            raise DataError(folder, "folder", f"holds the {begun} of a run, which this one would remove", remedy)
        if not begun:
            claim()
        return _Job(settings, conductor, ready, resume.comparable(values), folder, overrides, claim).run()


@dataclass(frozen=True, slots=True)
class _Job:
    """A job whose settings have been checked, in its locked folder.

    Args:
        compared: the part of the configuration that a resumed run must share, from `resume.comparable`.
    """

    settings: JobSettings
    conductor: Conductor
    ready: device.ReadyRasterizer
    compared: Mapping[str, Any]
    folder: Path
    overrides: Sequence[str] | None
    claim: Callable[[], None]
    began: float = field(default_factory=time.perf_counter)

    @property
    def chosen(self) -> plan.Chosen:
        return plan.Chosen(self.settings.method, list(self.settings.strategies), self.overrides)

    def run(self) -> float | None:
        settings, folder = self.settings, self.folder
        threads, reason = device.threads(settings.fit.threads)
        torch.set_num_threads(threads)
        load = functools.partial(scenes.load, settings.data, settings.prior, settings.fit.seed, self.conductor.prior)
        resumes = settings.fit.resume == resume.AUTO
        if resumes and (finished := resume.finished(folder, self.compared, load)) is not None:
            return finished.psnr
        require_paths(self.compared.get)
        if settings.data.save_lr is not None:
            capture, views = scenes.read(settings.data, None)
            _warn_if_few_placed(capture.notes)
            save_lr(capture, views, Path(settings.data.save_lr))
            return None
        # In a sweep the console shows one line per job; the rest is in run.log.
        level = logging.DEBUG if in_sweep() else logging.INFO
        asked, source = settings.fit, settings.data.source
        choices = plan.describe_choices(self.chosen, self.conductor, source, asked.iterations, asked.seed)
        _log.log(level, "%s", choices)
        found = resume.found(settings.fit.resume, folder, self.compared)
        scene = load()
        _warn_if_few_placed(scene.notes)
        device.log_choice(settings.rasterizer, self.ready)
        ready = self.ready.of_scene(scene.background, scene.cloud.means)
        there = scene.to(ready.device)
        state = self._start(there, ready)
        if found is not None:
            resume.restore(state, scene, *found)
        del found  # its tensors
        self.claim()
        files.sweep(folder)
        self._announce(scene, state, ready, f"{threads} ({reason})", level)
        results.remove_earlier(folder, all_files=state.t == 1)
        evaluation, training = self._train(scene, there, state, ready)
        seconds = time.perf_counter() - self.began
        _log.log(level, "%s", metrics.describe(folder, evaluation, seconds, _parts(scene, state, training)))
        if in_sweep():
            _log.info("%s", metrics.describe_job(HydraConfig.get().job.num, folder, evaluation, seconds))
        _warn_if_few_placed(scene.notes)
        return evaluation.psnr

    def _start(self, there: Scene, ready: device.ReadyRasterizer) -> TrainState:
        """The initial state, on the device of the scene and of the drawing."""
        settings, stretch = self.settings, self.settings.fit.stretch
        rates = scaled(settings.optim, stretch).of_run(settings.fit.iterations)
        return TrainState.start(
            there, self.conductor, settings=scaled(settings.fit, stretch), density=scaled(settings.density, stretch),
            rates=rates, mip=scaled(settings.mip, stretch), rules=ready.rules, rasterizer=ready.rasterizer,
        )  # fmt: skip

    def _announce(
        self, scene: Scene, state: TrainState, ready: device.ReadyRasterizer, threads: str, level: int
    ) -> None:
        """Log the plan, and settings without effect. A SettingError if the run does not fit into memory."""
        memory.release()
        machine = {
            "rasterizer": f"{ready.name}, kernel {ready.rules.kernel} px²",
            "threads": threads,
            "memory": memory.require(state, self.settings.fit.memory),
        }
        short, details = plan.describe(scene, state, self.chosen, machine)
        _log.log(level, "%s", short)
        _log.debug("%s", details)
        idle = [override for override in self.overrides or () if override.lstrip("+").startswith("density.")]
        if idle and not isinstance(state.density.settings, type(self.settings.density)):
            _log.warning("%s has no effect: %s densifies in place of it.", ", ".join(idle), state.density.name)

    def _watched(self, scene: Scene, painter: Painter) -> AbstractContextManager[Callable[[int], None] | None]:
        """Open the viewer if `fit.viewer` is set; the value of the context is called after each iteration."""
        if not self.settings.fit.viewer:
            return nullcontext()
        from clear_strategies.viewing.server import watched

        photos = {view.name: view.lr.image for view in scene.train}
        return watched(
            painter, {view.name: view.hr.camera for view in scene.train}, f"{scene.name} · {self.chosen.title}",
            lambda name: to_bytes(photos[name]),
        )  # fmt: skip

    def _train(
        self, scene: Scene, there: Scene, state: TrainState, ready: device.ReadyRasterizer
    ) -> tuple[Evaluation, float]:
        """Train to the end and write the files; return the scores and the seconds of training in this command."""
        title, alone = self.chosen.title, device.jobs_at_once() == 1
        painter = Painter(state.field, ready.make)
        before = state.seconds  # of the run that was resumed
        began = time.perf_counter()
        with signals.interrupted("before the run was finished", lambda: resume.newest(self.folder)):
            write_cameras(self.folder, scene)
            with (
                self._watched(scene, painter) as after_step,
                plan.progress_bar(state, after_step, title, shown=alone) as progress,
            ):
                checkpoints = self.folder / CHECKPOINTS
                fit(state, there, ready.rasterizer, checkpoints=checkpoints, config=self.compared, progress=progress)
            training = time.perf_counter() - began
            self.conductor.on_fit_end()  # frees memory for the results
            memory.release()
            evaluation = results.write_results(
                self.folder, scene, state, painter, self.chosen, backend=ready.name,
                down=self.settings.data.views.downsample, seconds=before + training, config=self.compared,
                antialiased=ready.rules.antialiased, own=self.settings.metrics,
            )  # fmt: skip
        return evaluation, training


_PREPARED: Final = "views prepared"
_AFTER: Final = ("maps", "evaluate", "video", "pictures")


def _warn_if_few_placed(notes: Mapping[str, str]) -> None:
    if few := notes.get(scenes.FEW_PLACED):
        _log.warning("%s.", few)


def _parts(scene: Scene, state: TrainState, training: float) -> dict[str, float]:
    """The seconds of each stage of the command, in order."""
    entries = state.conductor.work_log.entries
    before = {**scene.work_log.entries, **{name: e for name, e in entries.items() if name == _PREPARED}}
    after = sum(entries[name].seconds for name in _AFTER if name in entries)
    return {**{name: e.seconds for name, e in before.items()}, "training": training, "scores and pictures": after}
