"""One job, from its configuration to its outputs."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from clear_strategies import files
from clear_strategies.compose import ConductorSettings, tree
from clear_strategies.data.prepare import save_lr
from clear_strategies.data.priors import Bicubic
from clear_strategies.data.scene import Scene
from clear_strategies.density.base import DensifierSettings
from clear_strategies.errors import SettingError
from clear_strategies.jobs import device, resume, scene
from clear_strategies.jobs.device import Device, RasterizerSettings
from clear_strategies.jobs.lock import hold
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import plan, results, score_table, tensorboard
from clear_strategies.outputs.baseline import FOLDER as BASELINE
from clear_strategies.outputs.baseline import Baseline
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.outputs.progress import progress_bar
from clear_strategies.outputs.remarks import remarks
from clear_strategies.schedules import scaled
from clear_strategies.settings import build
from clear_strategies.training import memory
from clear_strategies.training.loop import fit
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.skips import Skips
from clear_strategies.training.state import TrainState
from clear_strategies.viewing import live
from clear_strategies.viewing.cameras import FILE as CAMERAS
from clear_strategies.viewing.cameras import read_cameras, write_cameras
from clear_strategies.viewing.look import Painter

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSettings(FitSettings):
    """Settings of a run: those of its training, what it shows and writes, and where it computes.

    Args:
        map_views: number of training views with maps of reliability and correction in maps/; 0: none.
        video: number of frames of path.mp4 and path.gif, a loop through the training cameras, 24 a second; 0: none.
        verbose: also show on the console the details that run.log holds; `-v` on the command line.
        page: write splat.html, a page that shows the field in any browser, if the field has at most this many Gaussians;
            0: never.
        log: tensorboard writes losses, PSNR, learning rates and a few pictures for TensorBoard; extra [log].
        viewer: look at the field in the browser while it trains; the address is logged. Extra [view].
        baseline: first train the same scene with the same settings, but without any strategy, into the folder baseline/ of
            the run. The contact sheet and the scores then show both. Without effect in a sweep, for a run that has no
            strategy, and with +method=NAME.
        resume: a run's folder or one of its checkpoints: continue from there, bit for bit. auto: look into the run's own
            folder. If the run is finished, train nothing; if it has checkpoints, continue from the newest one; else start
            from the beginning. Both apply to the baseline, too.
        device: cpu or cuda: where field, views and optimizer are. None: cuda if torch finds it and the rasterizer draws
            there, else cpu. A run may be resumed on another device; its bits then differ.
        threads: number of threads of torch and the kernels. None: all cores, divided by the jobs that run at once (joblib,
            Slurm).
    """

    map_views: int = 3
    video: int = 72
    page: int = 500_000
    log: Literal["tensorboard"] | None = None
    verbose: bool = False
    viewer: bool = False
    baseline: bool = False
    resume: str | None = None
    device: Device | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        FitSettings.__post_init__(self)
        if self.map_views < 0:
            raise SettingError(f"map_views must be at least 0, got {self.map_views}. 0 writes no maps.")
        if self.video < 0:
            raise SettingError(f"video must be at least 0 frames, got {self.video}. 0 writes no video.")
        if self.page < 0:
            raise SettingError(f"page must be at least 0 Gaussians, got {self.page}. 0 writes no page.")
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
        for decorate in self.decorators.values():
            decorate(Bicubic())  # likewise
        scene.require_factor(self.prior, self.data.views.sr_scale)


def settings_of(values: Mapping[str, Any]) -> JobSettings:
    """The settings of a resolved configuration, see `compose.tree`.

    Raises:
        SettingError: one cannot be used; the message begins with its key.
    """
    settings: JobSettings = build({**values, "rasterizer": device.rasterizer_node(values["rasterizer"])})
    return settings


@dataclass(frozen=True, slots=True)
class _Training:
    """One training of a job: the run itself, or its baseline.

    Args:
        compared: the configuration from `resume.comparable`, which a resumed run must have in common.
        folder: where its files go.
    """

    settings: JobSettings
    conductor: Conductor
    compared: Mapping[str, Any]
    folder: Path

    @classmethod
    def of(cls, settings: JobSettings, values: Mapping[str, Any], folder: Path) -> _Training:
        """A training with these settings. `values` is the configuration that they were built from."""
        return cls(settings, settings.conductor(settings.fit.stretch), resume.comparable(values), folder)

    @property
    def chosen(self) -> plan.Chosen:
        return plan.Chosen(self.settings.method, list(self.settings.strategies))

    def start(self, place: _Place, source: str | None) -> TrainState:
        """The state that training starts from: the initial one, or the checkpoint that `source` asks for.

        Args:
            source: a value of `fit.resume`.
        """
        settings, stretch = self.settings, self.settings.fit.stretch
        state = TrainState.start(
            place.there,
            self.conductor,
            settings=scaled(settings.fit, stretch),
            density=scaled(settings.density, stretch),
            rates=scaled(settings.optim, stretch).of_run(settings.fit.iterations),
            mip=scaled(settings.mip, stretch),
            skips=scaled(settings.skips, stretch),
        )
        resume.resume(state, source, self.folder, self.compared)
        return state

    def remove_earlier_metrics(self) -> None:
        metrics = self.folder / "metrics.json"
        if metrics.exists():
            _log.warning("%s: of an earlier run; removed, because its presence says that a run is finished.", metrics)
            metrics.unlink()


@dataclass(frozen=True, slots=True)
class _Place:
    """What the trainings of a job share: the scene, the rasterizer and the device.

    Args:
        scene: on the CPU.
        there: the same scene on the device of `drawing`.
        drawing: the rasterizer and its device.
        watch: called after each iteration.
    """

    scene: Scene
    there: Scene
    drawing: device.Drawing
    watch: Callable[[], None] | None


def run(config: DictConfig, folder: Path, watch: Callable[[], None] | None = None) -> float | None:
    """Run one job and write its files into `folder`.

    Every setting is checked before the folder is locked and before data is read.

    Args:
        watch: called after each iteration.

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
    if settings.fit.viewer:
        live.require_viewer()
    if settings.fit.log == "tensorboard":
        tensorboard.require_tensorboard()
    ours, baseline = _Training.of(settings, values, folder), None
    if settings.fit.baseline and _why_without_baseline(settings) is None:
        values_without = {**values, "strategies": {}}
        baseline = _Training.of(replace(settings, strategies={}), values_without, folder / BASELINE)
    drawing = device.drawing(settings.rasterizer, settings.fit.device)
    with hold(folder):
        files.sweep(folder)
        return _run(ours, baseline, drawing, watch)


def _why_without_baseline(settings: JobSettings) -> str | None:
    if settings.method is not None:
        return f"since +method={settings.method} is one itself"
    if not settings.strategies:
        return "since it has no strategy and is the baseline itself"
    if _in_sweep():
        return "since it is a job of a sweep, whose report compares the jobs"
    return None


def _in_sweep() -> bool:
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def _run(
    ours: _Training, baseline: _Training | None, drawing: device.Drawing, watch: Callable[[], None] | None
) -> float | None:
    settings = ours.settings
    if settings.fit.resume == resume.AUTO and (finished := resume.finished(ours.folder, ours.compared)) is not None:
        return finished[0]
    threads, why = device.threads(settings.fit.threads)
    torch.set_num_threads(threads)
    loaded = scene.load(settings.data, settings.prior, settings.fit.seed, ours.conductor.prior)
    if settings.data.save_lr is not None:
        save_lr(loaded, Path(settings.data.save_lr))
        return None
    device.log_choice(settings.rasterizer, drawing)
    drawing = drawing.over(loaded.background)
    place = _Place(loaded, loaded.to(drawing.device), drawing, watch)
    # Run and baseline are set up before either trains, so that an error does not come after the first has trained.
    source, first = settings.fit.resume, None
    if baseline is not None:
        source, of_baseline = resume.of_both(source, ours.compared, baseline.compared)
        if of_baseline != resume.AUTO or resume.finished(baseline.folder, baseline.compared) is None:
            first = baseline.start(place, of_baseline)
    state = ours.start(place, source)
    memory.release()
    # In a sweep the console shows one line per job; the rest is in run.log.
    level = logging.DEBUG if _in_sweep() else logging.INFO
    found, most = memory.needs(state, drawing.rasterizer), getattr(state.density.settings, "max_gaussians", None)
    machine = {
        "rasterizer": f"{drawing.name}, kernel {drawing.kernel} px²",
        "threads": f"{threads} ({why})",
        "memory": memory.says(found, most),
    }
    said = plan.describe(loaded, state, ours.chosen, machine)
    _log.log(level, "%s", said.short)
    _log.debug("%s", said.details)
    memory.require(found, None if settings.fit.memory is None else settings.fit.memory << 20, most)
    if settings.fit.baseline and baseline is None:
        _log.log(level, "fit.baseline: no baseline trains beside this run, %s.", _why_without_baseline(settings))
    ours.remove_earlier_metrics()
    beside = None if baseline is None else _trained_first(baseline, first, place)
    first = None  # its memory is for what trains now
    evaluation, seconds = _train(ours, state, place, beside)
    for remark in remarks(state):
        _log.log(level, "%s", remark)
    _log.log(level, "%s", score_table.describe(ours.folder, evaluation, seconds, beside))
    if _in_sweep():
        _log.info("%s", score_table.describe_job(HydraConfig.get().job.num, ours.folder, evaluation, seconds))
    mean = evaluation.mean("test") or evaluation.mean("train")
    return None if mean is None else mean.psnr


def _trained_first(training: _Training, state: TrainState | None, place: _Place) -> Baseline:
    """Train the baseline and read its results.

    Args:
        state: to train from; None if the baseline is finished, so that its files are only read.
    """
    if state is not None:
        _log.info(
            "the baseline trains first: no strategy, all else as above (fit.baseline=false leaves it out): %s",
            training.folder,
        )
        training.remove_earlier_metrics()
        _train(training, state, place)
    baseline = Baseline.read(training.folder)
    _log.info("%s", score_table.describe_baseline(baseline))
    return baseline


@contextmanager
def _watched(training: _Training, state: TrainState, place: _Place) -> Iterator[Callable[[], None]]:
    """Open the viewer (`fit.viewer`) and the log (`fit.log`), and yield a function to call after each iteration. It updates
    both and calls the job's watch.
    """
    fit_settings, painter = training.settings.fit, Painter(state.field, place.drawing.make)
    calls = [] if place.watch is None else [place.watch]
    with ExitStack() as open_:
        if fit_settings.viewer:
            saved, title = read_cameras(training.folder / CAMERAS), f"{place.scene.name} · {training.chosen.title}"
            turn = open_.enter_context(live.watched(painter, saved, title, _tell_address))
            calls.append(lambda: turn(state.t - 1))
        if fit_settings.log == "tensorboard":
            calls.append(open_.enter_context(tensorboard.logged(training.folder, state, place.scene, painter)))

        def after_step() -> None:
            for call in calls:
                call()

        yield after_step


def _tell_address(address: str) -> None:
    _log.info("look while it trains: %s", address)


def _train(
    training: _Training, state: TrainState, place: _Place, beside: Baseline | None = None
) -> tuple[Evaluation, float]:
    """Train to the end and write the files; return the scores and the seconds of training.

    Args:
        beside: the finished baseline, to show next to the run's results.
    """
    settings, rasterizer = training.settings, place.drawing.rasterizer
    write_cameras(training.folder, place.scene)
    began = time.perf_counter() - state.seconds  # with what a resumed run took before
    watched = _watched(training, state, place)
    alone = device.jobs_at_once() == 1
    with watched as after_step, progress_bar(state, after_step, training.chosen.title, shown=alone) as progress:
        checkpoints = training.folder / resume.CHECKPOINTS
        fit(state, place.there, rasterizer, checkpoints=checkpoints, config=training.compared, progress=progress)
    seconds = time.perf_counter() - began
    training.conductor.on_fit_end()  # its memory is for the results
    memory.release()
    evaluation = results.write_results(
        training.folder,
        place.scene,
        state,
        rasterizer,
        training.chosen,
        backend=place.drawing.name,
        down=settings.data.views.downsample,
        map_views=settings.fit.map_views,
        painter=Painter(state.field, place.drawing.make),
        video_frames=settings.fit.video,
        page_gaussians=settings.fit.page,
        seconds=seconds,
        config=training.compared,
        baseline=beside,
    )
    return evaluation, seconds
