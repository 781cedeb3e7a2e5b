"""One job, from its configuration to its outputs."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from clear_strategies import files
from clear_strategies.compose import tree
from clear_strategies.data.prepare import save_lr
from clear_strategies.data.scene import Scene
from clear_strategies.jobs import device, resume, scene
from clear_strategies.jobs.budget import Budget
from clear_strategies.jobs.budget import Plan as TimePlan
from clear_strategies.jobs.lock import hold
from clear_strategies.jobs.settings import JobSettings, settings_of
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import plan, results, score_table, tensorboard
from clear_strategies.outputs.baseline import FOLDER as BASELINE
from clear_strategies.outputs.baseline import Baseline, overrides_of
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.outputs.progress import progress_bar
from clear_strategies.schedules import scaled
from clear_strategies.training import memory, signals
from clear_strategies.training.loop import fit
from clear_strategies.training.state import TrainState
from clear_strategies.viewing import live
from clear_strategies.viewing.cameras import FILE as CAMERAS
from clear_strategies.viewing.cameras import read_cameras, write_cameras
from clear_strategies.viewing.look import Painter

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Training:
    """One training of a job: the run itself, or its baseline.

    Args:
        compared: the configuration from `resume.comparable`, which a resumed run must have in common.
        folder: where its files go.
        pictures: what shows it there; None for a baseline, which the run's own pictures show.
        overrides: of the command line, for the report; None: unknown.
        timed: how it keeps to its minutes; None: it has no limit.
    """

    settings: JobSettings
    conductor: Conductor
    compared: Mapping[str, Any]
    folder: Path
    pictures: results.Pictures | None
    overrides: Sequence[str] | None = None
    timed: TimePlan | None = None

    @classmethod
    def of(cls, settings: JobSettings, values: Mapping[str, Any], folder: Path) -> _Training:
        """The run itself, with these settings. `values` is the configuration that they were built from."""
        fit, conductor = settings.fit, settings.conductor(settings.fit.stretch)
        pictures = results.Pictures(fit.map_views, fit.video, fit.page)
        return cls(settings, conductor, resume.comparable(values), folder, pictures)

    def baseline(self, values: Mapping[str, Any]) -> _Training:
        """The training beside this one, without any strategy, in a folder within its folder."""
        without = replace(self.settings, strategies={})
        alone = _Training.of(without, {**values, "strategies": {}}, self.folder / BASELINE)
        overrides = None if self.overrides is None else overrides_of(self.overrides)
        return replace(alone, pictures=None, overrides=overrides)

    def lasting(self, iterations: int) -> _Training:
        """The same training with this number of iterations, whatever time it takes."""
        settings = replace(self.settings, fit=replace(self.settings.fit, iterations=iterations, minutes=None))
        compared = {**self.compared, "fit.iterations": iterations, "fit.minutes": None}
        return replace(self, settings=settings, conductor=settings.conductor(settings.fit.stretch), compared=compared)

    def with_data(self, data: scene.DataSettings) -> _Training:
        """The same training with this limit of its HR images."""
        if data is self.settings.data:
            return self
        compared = {**self.compared, "data.views.max_hr_megapixels": data.views.max_hr_megapixels}
        return replace(self, settings=replace(self.settings, data=data), compared=compared)

    def timed_by(self, budget: Budget, place: _Place, trainings: int) -> _Training:
        """The same training with as many iterations as fit into the time that is left for it and the others."""
        fit = self.settings.fit
        pilot, rasterizer = self.lasting(fit.iterations).start(place, None), place.drawing.rasterizer
        plan = budget.iterations(pilot, rasterizer, trainings=trainings, maps=fit.map_views, frames=fit.video)
        return replace(self.lasting(plan.iterations), timed=plan)

    @property
    def chosen(self) -> plan.Chosen:
        return plan.Chosen(self.settings.method, list(self.settings.strategies), self.overrides)

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
            near=place.drawing.near,
        )
        resume.resume(state, source, self.folder, self.compared)
        return state


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


def run(
    config: DictConfig,
    folder: Path,
    watch: Callable[[], None] | None = None,
    overrides: Sequence[str] | None = None,
) -> float | None:
    """Run one job and write its files into `folder`.

    Every setting is checked before the folder is locked and before data is read.

    Args:
        watch: called after each iteration.
        overrides: that the configuration was composed of, which the report names the run by.

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
    budget = None if settings.fit.minutes is None else Budget.of(settings.fit.minutes)
    if settings.fit.viewer:
        live.require_viewer()
    if settings.fit.log == "tensorboard":
        tensorboard.require_tensorboard()
    ours, baseline = replace(_Training.of(settings, values, folder), overrides=overrides), None
    if settings.fit.baseline and _why_without_baseline(settings) is None:
        baseline = ours.baseline(values)
    drawing = device.drawing(settings.rasterizer, settings.fit.device)
    with hold(folder), signals.interrupted("before training began"):
        files.sweep(folder)
        return _run(ours, baseline, drawing, watch, budget)


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
    ours: _Training,
    baseline: _Training | None,
    drawing: device.Drawing,
    watch: Callable[[], None] | None,
    budget: Budget | None,
) -> float | None:
    settings = ours.settings
    if settings.fit.resume == resume.AUTO and (finished := resume.finished(ours.folder, ours.compared)) is not None:
        return finished[0]
    threads, why = device.threads(settings.fit.threads)
    torch.set_num_threads(threads)
    loaded, data = _loaded(ours, budget)
    ours, baseline = ours.with_data(data), None if baseline is None else baseline.with_data(data)
    if settings.data.save_lr is not None:
        save_lr(loaded, Path(settings.data.save_lr))
        return None
    device.log_choice(settings.rasterizer, drawing)
    drawing = drawing.over(loaded.background)
    place = _Place(loaded, loaded.to(drawing.device), drawing, watch)
    if budget is not None:
        ours = ours.timed_by(budget, place, 1 if baseline is None else 2)
        baseline = None if baseline is None else baseline.lasting(ours.settings.fit.iterations)
    # Run and baseline are set up before either trains, so that an error does not come after the first has trained.
    source, first = settings.fit.resume, None
    if baseline is not None:
        source, of_baseline = resume.of_both(source, ours.compared, baseline.compared)
        if of_baseline != resume.AUTO or resume.finished(baseline.folder, baseline.compared) is None:
            first = baseline.start(place, of_baseline)
    state = ours.start(place, source)
    idle = [override for override in ours.overrides or () if override.lstrip("+").startswith("density.")]
    if idle and not isinstance(state.density.settings, type(settings.density)):
        _log.warning("%s has no effect: %s densifies in place of it.", ", ".join(idle), state.density.name)
    memory.release()
    # In a sweep the console shows one line per job; the rest is in run.log.
    level = logging.DEBUG if _in_sweep() else logging.INFO
    found, most = memory.needs(state, drawing.rasterizer), state.density.cap
    machine = {
        "rasterizer": f"{drawing.name}, kernel {drawing.kernel} px²",
        "threads": f"{threads} ({why})",
        "memory": memory.says(found, most),
        **({} if ours.timed is None else {"time": ours.timed.says()}),
    }
    said = plan.describe(loaded, state, ours.chosen, machine)
    _log.log(level, "%s", said.short)
    _log.debug("%s", said.details)
    memory.require(found, None if settings.fit.memory is None else settings.fit.memory << 20, most)
    if settings.fit.baseline and baseline is None:
        _log.log(level, "fit.baseline: no baseline trains beside this run, %s.", _why_without_baseline(settings))
    results.remove_earlier(ours.folder, all_files=state.t == 1)
    if baseline is None and state.t == 1:
        results.remove_earlier(ours.folder / BASELINE, all_files=True)
    beside = None if baseline is None else _trained_first(baseline, first, place)
    first = None  # its memory is for what trains now
    evaluation, seconds = _train(ours, state, place, beside)
    for remark in plan.remarks(state):
        _log.log(level, "%s", remark)
    _log.log(level, "%s", score_table.describe(ours.folder, evaluation, seconds, beside))
    if _in_sweep():
        _log.info("%s", score_table.describe_job(HydraConfig.get().job.num, ours.folder, evaluation, seconds))
    mean = evaluation.mean("test") or evaluation.mean("train")
    return None if mean is None else mean.psnr


def _loaded(training: _Training, budget: Budget | None) -> tuple[Scene, scene.DataSettings]:
    """The scene, and the data set's settings with the size of HR that the time allows."""
    settings, capture, data = training.settings, None, training.settings.data
    if budget is not None:
        capture = data.reader()
        data = scene.timed(capture, data, settings.prior, budget)
    return scene.load(data, settings.prior, settings.fit.seed, training.conductor.prior, capture), data


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
        results.remove_earlier(training.folder, all_files=state.t == 1)
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
    if training.timed is not None:
        calls.append(training.timed.hurry(state))
    with ExitStack() as open_:
        if fit_settings.viewer:
            saved, title = read_cameras(training.folder / CAMERAS), f"{place.scene.name} · {training.chosen.title}"
            tell = functools.partial(_log.info, "look while it trains: %s")
            turn = open_.enter_context(live.watched(painter, saved, title, tell))
            calls.append(lambda: turn(state.t - 1))
        if fit_settings.log == "tensorboard":
            calls.append(open_.enter_context(tensorboard.logged(training.folder, state, place.scene, painter)))

        def after_step() -> None:
            for call in calls:
                call()

        yield after_step


def _train(
    training: _Training, state: TrainState, place: _Place, beside: Baseline | None = None
) -> tuple[Evaluation, float]:
    """Train to the end and write the files; return the scores and the seconds of training.

    Args:
        beside: the finished baseline, to show next to the run's results.
    """
    settings, rasterizer, alone = training.settings, place.drawing.rasterizer, device.jobs_at_once() == 1
    began = time.perf_counter() - state.seconds  # with what a resumed run took before
    with signals.interrupted("before the run was finished", lambda: resume.newest(training.folder)):
        write_cameras(training.folder, place.scene)
        watched = _watched(training, state, place)
        with watched as after_step, progress_bar(state, after_step, training.chosen.title, shown=alone) as progress:
            checkpoints = training.folder / resume.CHECKPOINTS
            fit(state, place.there, rasterizer, checkpoints=checkpoints, config=training.compared, progress=progress)
        seconds = time.perf_counter() - began
        training.conductor.on_fit_end()  # its memory is for the results
        memory.release()
        evaluation = results.write_results(
            training.folder, place.scene, state, rasterizer, training.chosen,
            backend=place.drawing.name, down=settings.data.views.downsample,
            painter=Painter(state.field, place.drawing.make), pictures=training.pictures, seconds=seconds,
            config=training.compared, antialiased=place.drawing.antialiased, baseline=beside,
        )  # fmt: skip
    return evaluation, seconds
