"""Floor 4: the training loop. `iterate` is one step of the method; `fit` is everything around it.

Nothing here is random by itself: the view of iteration t, its dropout mask and the children of its splits are functions
of (seed, t), so a resumed run is bitwise the run that was never interrupted.
"""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final, get_args

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.core import deferred, images
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import conflict_columns
from clear_strategies.core.view import View
from clear_strategies.data.scene import Scene
from clear_strategies.density.adaptive import Densifier, DensifierSettings, cameras_extent
from clear_strategies.errors import ClearError, DataError
from clear_strategies.merging.conductor import Conductor, Update
from clear_strategies.schedules import REFERENCE_ITERATIONS, milestone
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import Checkpoint
from clear_strategies.training.compiled_step import CompiledStep, FusedMode, compiled_step_for
from clear_strategies.training.field import GaussianField
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.skips import SkipPolicy, Skips
from rasterizers import native
from rasterizers.interface import Rasterizer

_log = logging.getLogger(__name__)

PROBING: Final = "probe test views"
"""The work_log's stage of looking at them."""


@dataclass(frozen=True, slots=True)
class FitSettings:
    """How long, and what is looked at on the way.

    Args:
        iterations: steps, one view each. scale_schedule: stretch every milestone from 10,000 iterations to these.
        seed: of view order, dropout and splits.
        max_degree: of spherical harmonics; one more is active every `degree_every` iterations.
        probe_every: iterations between looks at the test views; 0: never. probe_views: how many of them.
        checkpoint_every: iterations between checkpoints; 0: only when interrupted. keep: how many stay.
        fused: "auto" merges, corrects, anchors and steps in one compiled pass where it can, and leaves out rows that would
            not move; "every_row" leaves out none (the same bits); "off" takes the readable path.
    """

    iterations: int = 10_000
    scale_schedule: bool = True
    seed: int = 0
    max_degree: int = 3
    degree_every: int = milestone(1_000)
    probe_every: int = milestone(1_000)
    probe_views: int = 3
    checkpoint_every: int = milestone(2_500)
    keep: int = 3
    fused: FusedMode = "auto"

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}.")
        if self.max_degree not in (0, 1, 2, 3):
            raise ValueError(f"max_degree must be 0, 1, 2 or 3, got {self.max_degree}.")
        if self.keep < 1:
            raise ValueError(f"keep must be at least 1 checkpoint, got {self.keep}.")
        if self.fused not in get_args(FusedMode):
            raise ValueError(
                f"fused must be one of {', '.join(get_args(FusedMode))}, got {self.fused!r}. In a YAML file, off is quoted."
            )

    @property
    def stretch(self) -> float:
        """The factor on milestones."""
        return self.iterations / REFERENCE_ITERATIONS if self.scale_schedule else 1.0


class DivergedError(ClearError, FloatingPointError):
    """A parameter is no longer a finite number; the last checkpoint is from before that."""


class Interrupted(ClearError):
    """The run was asked to stop (Ctrl-C, SIGTERM, a cluster's own signal); it finished its step and saved."""

    def __init__(self, signum: int, saved: Path | None, t: int) -> None:
        self.signum = signum
        where = f"Go on with fit.resume={saved}" if saved else "Nothing was saved: this run keeps no checkpoints"
        super().__init__(f"stopped by {signal.Signals(signum).name} before iteration {t}. {where}.")

    @property
    def exit_code(self) -> int:
        return 128 + self.signum


@dataclass(slots=True)
class TrainState:
    """Everything that changes while training, on the device where the views lie.

    Args:
        t: the iteration to come, from 1.
        history: one row an iteration; to be looked at by `told`, for on a device its numbers are read late.
    """

    field: GaussianField
    conductor: Conductor
    optimizer: Adam
    density: Densifier
    settings: FitSettings
    mip: MipFilter
    views: tuple[View, ...]
    t: int = 1
    history: list[dict[str, Number]] = field(default_factory=list)
    compiled_step: CompiledStep | None = None
    skip_policy: SkipPolicy = field(default_factory=SkipPolicy)

    @classmethod
    def start(
        cls,
        scene: Scene,
        conductor: Conductor,
        *,
        settings: FitSettings,
        density: DensifierSettings,
        rates: LearningRates,
        mip: MipFilter,
        skips: Skips | None = None,
    ) -> TrainState:
        """The state before the first iteration, where the scene's views lie; milestones in the settings are already those
        of this run.
        """
        device = scene.device
        theta = GaussianField.from_cloud(scene.cloud, max_degree=settings.max_degree).to(device)
        extent = cameras_extent(torch.stack([view.hr.camera.center.float() for view in scene.train]))
        white = all(c == 1.0 for c in scene.background)
        control = density.densifier(
            len(theta), extent=extent, seed=settings.seed, white_background=white, device=device
        )
        optimizer = Adam(theta.raw(), rates, extent)
        conductor.on_fit_start(len(scene.train), settings.seed, device)
        step = compiled_step_for(conductor, optimizer, settings.fused)
        state = cls(
            theta,
            conductor,
            optimizer,
            control,
            settings,
            mip,
            scene.train,
            compiled_step=step,
            skip_policy=SkipPolicy(skips),
        )
        state.refilter()
        return state

    def view(self) -> View:
        """The view of this iteration: every view once, in random order, then again in another."""
        epoch, position = divmod(self.t - 1, len(self.views))
        generator = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + epoch)
        order = torch.randperm(len(self.views), generator=generator, device=generator.device)
        return self.views[int(order[position])]

    @property
    def device(self) -> torch.device:
        """Where the field lies, and everything else per Gaussian or pixel."""
        return self.field.means.device

    def history_as_floats(self) -> Sequence[dict[str, float]]:
        """The history, all of it read."""
        return deferred.resolve(self.history)

    @property
    def seconds(self) -> float:
        """Of training, until the last iteration, whoever trained."""
        return self.history_as_floats()[-1]["seconds"] if self.history else 0.0

    @property
    def ended(self) -> bool:
        """Whether all iterations are done."""
        return self.t > self.settings.iterations

    def advance(self) -> None:
        """On to the next iteration; from a plateau of the training views straight to its end."""
        done, self.t = self.t, self.t + 1
        if not self.skip_policy.settled(self.history, done):
            return
        to, skips = min(self.skip_policy.skips.plateau_to, self.settings.iterations), self.skip_policy.skips
        left_out, self.t = to + 1 - self.t, to + 1
        self.optimizer.steps += left_out  # the learning rates follow the iteration
        self.conductor.work_log.skip(
            "iterations", "the training views stopped improving (skips.plateau_gain)", left_out
        )
        _log.info(
            "t=%d: the training views' loss fell by less than %.1f %% in %d iterations; training goes on at t=%d.",
            done, 100 * skips.plateau_gain, skips.plateau_window, self.t,
        )  # fmt: skip

    def refilter(self) -> None:
        """Make the 3D filter anew from where the Gaussians are now."""
        cameras = [(v.hr if self.mip.cameras == "hr" else v.lr).camera for v in self.views]
        self.field.update_filter(cameras, self.mip.variance)

    def resized(self, parents: Int[Tensor, " M"]) -> None:
        """Row i of everything per Gaussian now comes from row parents[i]; field and optimizer have followed already."""
        self.conductor.on_resize(parents)
        self.refilter()

    def filter_due(self) -> bool:
        """Structure changes refresh the filter themselves; between and after them it follows the moving means."""
        return self.t % self.mip.every == 0 and self.t <= self.settings.iterations - self.mip.last

    def checkpoint(self, config: Mapping[str, Any]) -> Checkpoint:
        tensors: dict[str, Tensor] = {}
        for prefix, table in (
            ("field", {**self.field.raw(), "filter_3d": self.field.filter_3d}),
            ("optimizer", self.optimizer.state_dict()),
            ("density", self.density.state_dict()),
            ("strategies", self.conductor.state_dict()),
        ):
            tensors |= {f"{prefix}/{name}": value for name, value in table.items()}
        facts = {"optimizer_steps": float(self.optimizer.steps), "degree": float(self.field.degree)}
        return Checkpoint(
            self.t,
            tensors,
            config,
            facts,
            list(self.history_as_floats()),
            self.conductor.work_log.state_dict(),
            self.device.type,
        )

    def restore(self, saved: Checkpoint, source: Path) -> None:
        """Go on from a checkpoint, whatever device it was made on.

        Raises:
            DataError: its tensors do not belong to this run.
        """
        tables: dict[str, dict[str, Tensor]] = {}
        for name, value in saved.tensors.items():
            prefix, _, rest = name.partition("/")
            tables.setdefault(prefix, {})[rest] = value
        try:
            parameters, device = tables["field"], self.device
            self.field = GaussianField(parameters, degree=int(saved.facts["degree"])).to(device)
            self.field.filter_3d = parameters["filter_3d"].to(device, copy=True)
            self.optimizer.load_state_dict(tables["optimizer"], int(saved.facts["optimizer_steps"]))
            self.density.load_state_dict(tables["density"])
            self.conductor.load_state_dict(tables.get("strategies", {}))
            self.conductor.work_log.load_state_dict(saved.work_log)
        except (KeyError, ValueError, TypeError) as error:
            raise DataError(
                source, "tensors", f"do not fit this run ({error})", "resume with the run's own config"
            ) from error
        self.t = saved.t
        self.history = [dict(row) for row in saved.history]


def iterate(s: TrainState, rasterizer: Rasterizer) -> Update:
    """One iteration, in the paper's order."""
    t, θ, ask, stage = s.t, s.field, s.conductor, s.conductor.work_log.stage
    θ.degree = min(s.settings.max_degree, (t - 1) // max(1, s.settings.degree_every))
    view = s.skip_policy.view(s.view(), t)
    scales = {"lr": ask.wants_lr, "hr": ask.wants_hr(t) and (not ask.wants_lr or s.skip_policy.hr_due(t, ask.work_log))}
    tiles = s.skip_policy.wanted(view, rasterizer.tile, ask.work_log) if scales["hr"] else None
    z = ask.gate(t, len(θ))  # zᵗ             Eq. 15       SVS
    with stage(f"render {' + '.join(scale.upper() for scale, wanted in scales.items() if wanted)}"):
        lr, hr = θ.render_scales(rasterizer, view, gate=z, tiles=tiles, **scales)  # Î_LR, Î_HR     Eq. 2, 3
    drawn = [shot for shot in (lr, hr) if shot is not None]
    u = ask.update(θ.raw(), lr, hr, view, t, s.compiled_step)
    if u.grads is not None:  # else the compiled step has made the step
        with stage("optimizer"):
            s.optimizer.step(θ.raw(), u.grads, torch.stack([shot.visible for shot in drawn]).any(0))
            θ.constrain()
    ask.after_step(θ.raw(), t)  # θᵃ at t = t_a  Eq. 16       SVS
    s.density.accumulate(u, drawn[-1], t)  # S^dens         Eq. 14
    with stage("density and filter"):
        # clone · split · prune = parents[M]
        restructured = ask.may_densify(t) and s.density.step(θ, s.optimizer, t, s.resized)
        if s.filter_due() and not restructured:  # the means have not moved since
            s.refilter()
    low = images.area_mean(drawn[-1].image, view.factor) if lr is None else lr.image
    s.history.append(_row(s, u, low, view))
    s.advance()
    return u


def cores(state: TrainState, rasterizer: Rasterizer) -> AbstractContextManager[None]:
    """To train inside of: the cores go to the compiled kernels where they do nearly all of the work."""
    if rasterizer.traits.own_threads and state.compiled_step is not None:
        return native.own_threads(native.threads())
    return nullcontext()


Progress = Callable[[TrainState], None]


def fit(
    state: TrainState,
    scene: Scene,
    rasterizer: Rasterizer,
    *,
    checkpoints: Path | None = None,
    config: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> TrainState:
    """Iterate to the end, looking at test views and saving checkpoints on the way.

    Args:
        checkpoints: where to save; None saves nothing. config: what a resumed run must agree with.
        progress: called after each iteration.

    Raises:
        Interrupted: after a signal, once the step is done and saved.
        DivergedError: a parameter became NaN or infinite; the message names it.
    """
    settings = state.settings

    def save() -> Path | None:
        if checkpoints is None:
            return None
        return checkpoint.save(checkpoints, state.checkpoint(config or {}), keep=settings.keep)

    began = time.perf_counter() - state.seconds
    with _deferred_signals() as pending, cores(state, rasterizer):
        ended = state.ended
        while not ended:
            done = state.t
            iterate(state, rasterizer)
            ended = state.ended
            state.history[-1]["seconds"] = time.perf_counter() - began
            if settings.probe_every and (done % settings.probe_every == 0 or ended):
                _look(state, scene, rasterizer, done)
            if progress is not None:
                progress(state)
            if pending:
                raise Interrupted(_foremost(pending), save(), state.t)
            if settings.checkpoint_every and done % settings.checkpoint_every == 0 and not ended:
                _require_finite(state)
                save()
    _require_finite(state)
    save()
    state.history_as_floats()
    return state


def _row(s: TrainState, u: Update, lr_image: Tensor, view: View) -> dict[str, Number]:
    """One line of the history."""
    row: dict[str, Number] = {
        "t": float(s.t),
        "lambda_hr": s.conductor.objective.lambda_hr(s.t),
        "psnr_train_lr": _psnr(lr_image, view.lr.image),
        "n_gaussians": float(len(s.field)),
        "detail_abs": deferred.scalar(s.field.detail.data.abs().mean()),
    }
    row |= {f"loss_{name}": value for name, value in u.losses.items()}
    return row | conflict_columns(u.conflict) | dict(u.logs)


def _psnr(image: Tensor, target: Tensor) -> Number:
    return deferred.defer(_decibels, deferred.scalar((image.clamp(0, 1) - target).square().mean()))


def _decibels(mse: float) -> float:
    return -10 * math.log10(max(mse, 1e-10))


def _look(state: TrainState, scene: Scene, rasterizer: Rasterizer, done: int) -> None:
    """Add what the test views say to the history's last row."""
    work_log = state.conductor.work_log
    if state.density.reset_due(done) and not state.ended:
        work_log.skip(PROBING, "opacities were reset in this iteration")
        return
    with work_log.stage(PROBING):
        psnr = _probe(state, scene, rasterizer)
    if psnr is not None:
        state.history[-1]["psnr_test"] = psnr


def _probe(state: TrainState, scene: Scene, rasterizer: Rasterizer) -> float | None:
    """Mean PSNR of the first few test views at HR; None where HR is unknown."""
    values = []
    for view in scene.test[: state.settings.probe_views]:
        if view.truth is not None:
            values.append(_psnr(state.field.render(rasterizer, view.hr.camera), view.truth))
    return sum(deferred.read(values)) / len(values) if values else None


def _require_finite(state: TrainState) -> None:
    for name, value in state.field.raw().items():
        finite = torch.isfinite(value)
        if not bool(finite.all()):
            bad = (~finite).flatten(1).any(1) if value.dim() > 1 else ~finite
            raise DivergedError(
                f"t={state.t - 1}: {name} of {int(bad.sum())} Gaussians is not finite, first Gaussian "
                f"{int(bad.nonzero()[0])}. The last checkpoint is from before that; lower the learning rates."
            )


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
# With these a cluster announces the end of a job, if whoever started the job has set a handler.
_ANNOUNCEMENTS: Final = tuple(getattr(signal, name) for name in ("SIGUSR1", "SIGUSR2") if hasattr(signal, name))


@contextmanager
def _deferred_signals() -> Iterator[list[int]]:
    """Collect the first SIGINT or SIGTERM instead of dying in the middle of a step; a second one acts at once.

    A signal that somebody handles to hand the job in again is collected too: that handler would leave before saving. It
    is in force again when `fit` raises Interrupted, so that whoever catches it can raise the signal anew.
    """
    pending: list[int] = []

    def note(signum: int, _frame: FrameType | None) -> None:
        pending.append(signum)
        again = " Once more to leave at once." if signum in _SIGNALS else ""
        _log.warning("%s: finishing this step, then saving.%s", signal.Signals(signum).name, again)
        for s in _SIGNALS:
            signal.signal(s, before[s])

    handled = [s for s in _ANNOUNCEMENTS if callable(signal.getsignal(s))]
    try:
        before = {s: signal.signal(s, note) for s in (*_SIGNALS, *handled)}
    except ValueError:  # not the main thread: signals are somebody else's
        yield pending
        return
    try:
        yield pending
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)


def _foremost(pending: list[int]) -> int:
    """A cluster may send SIGTERM with its announcement; the announcement says what to do."""
    return next((s for s in pending if s in _ANNOUNCEMENTS), pending[0])
