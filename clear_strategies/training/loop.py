"""The training loop. `iterate` is one step of the method; `fit` runs, evaluates, saves and stops.

Nothing here depends on global random state: the view of iteration t, its dropout mask and the children of its splits are
functions of (seed, t), so a resumed run has the same bits as one that was never interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

import torch

from clear_strategies import files
from clear_strategies.core import deferred, images
from clear_strategies.core.deferred import Number
from clear_strategies.core.finite import require_finite
from clear_strategies.core.gradients import conflict_columns
from clear_strategies.core.seeds import generator_at
from clear_strategies.core.step import Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.data.priors import Bicubic, network_of
from clear_strategies.data.scene import Scene
from clear_strategies.errors import AnswerError, DivergedError
from clear_strategies.merging.iteration import require_finite_parts
from clear_strategies.merging.logs import computed
from clear_strategies.merging.skips import PLATEAU_LOSS
from clear_strategies.signals import Interrupted, deferred_signals, foremost
from clear_strategies.training import checkpoint
from clear_strategies.training.clock import Clock
from clear_strategies.training.evaluation import evaluate, loss_of_views, psnr_of
from clear_strategies.training.field import FieldShot
from clear_strategies.training.replayed_iteration import ExtraViewInputs, ViewInputs, replayed, replays_for
from clear_strategies.training.state import TrainState
from rasterizers import native
from rasterizers.interface import Camera, Color, Rasterizer, over

EXTRA_LOSS: Final = "loss_extra"
"""The history's column with the LR loss of the iteration's last extra view."""


def iterate(s: TrainState, rasterizer: Rasterizer) -> None:
    """One iteration, in the paper's order."""
    t, θ, conductor, stage = s.t, s.field, s.conductor, s.conductor.work_log.stage
    θ.degree = min(s.settings.max_degree, (t - 1) // max(1, s.settings.degree_every))
    view = conductor.skips.view(view_at(s), t)
    z, background = conductor.gate(t, len(θ)), conductor.background(t)  # zᵗ             Eq. 15       SVS
    hr_due = conductor.wants_hr(t, scored=s.density.collects(t))
    scales = {"lr": conductor.lr_due(view, hr_due), "hr": hr_due}
    step, row = learn(s, rasterizer, ViewInputs(t, view, scales, z, background))
    conductor.draw(t, θ.means.data, partial(enlarged, s, rasterizer, background))
    extra = extra_steps(s, rasterizer, conductor.extra_views(t), background)
    conductor.after_step(θ.raw(), step)  # θᵃ at t = t_a  Eq. 16       SVS
    with stage("density and filter"):
        # clone · split · prune = parents[M]
        restructured = conductor.may_densify(t) and s.restructure()
        if s.filter_due() and not restructured and not s.remove_undrawn():  # each recomputes the filter
            s.refilter()
    row = _row(s) | row | extra
    s.history.append(row | computed(conductor.logs.scalars(row)))
    if t in s.plateau.measurements and not (restructured or s.reset_due(t)):
        with stage("loss of the training views"):
            s.history[-1][PLATEAU_LOSS] = loss_of_views(s, rasterizer)
    s.advance()


@replayed
def learn(s: TrainState, rasterizer: Rasterizer, inputs: ViewInputs) -> tuple[Step, dict[str, Number]]:
    """What an iteration does with its view: render, compare, step on the merged gradient, and accumulate statistics.

    Nothing here may read a number from the device, see `replayed`.
    """
    t, view, θ, conductor, stage = inputs.t, inputs.view, s.field, s.conductor, s.conductor.work_log.stage
    with stage(f"render {' + '.join(scale.upper() for scale, wanted in inputs.scales.items() if wanted)}"):
        lr, hr = θ.render_scales(  # Î_LR, Î_HR     Eq. 2, 3
            over(rasterizer, inputs.background), view, gate=inputs.gate, **inputs.scales
        )
    params, compiled, scored = θ.raw(), s.compiled_step, s.density.collects(t)
    *_, finest = (shot for shot in (lr, hr) if shot is not None)
    if compiled is None:
        u = conductor.update(params, lr, hr, view, t, scored=scored, looked_up=inputs.looked_up)
        conflict = u.conflict
        with stage("optimizer"):
            s.optimizer.step(params, u.grads or {})
            θ.constrain()
    else:
        g_lr, from_hr, u = conductor.gradients(
            params, lr, hr, view, t, FieldShot.gradients, scored=scored, weights=compiled.weights(t),
            looked_up=inputs.looked_up,
        )  # fmt: skip
        with stage("per-Gaussian pass"):  # the same in one
            conflict = compiled.step(params, finest, g_lr, from_hr, t)
    if scored:
        s.density.accumulate(u, finest, t)  # S^dens         Eq. 14
    low = images.area_mean(finest.image, view.factor) if lr is None else lr.image
    photo = view.lr.over(inputs.background, view.background)
    row: dict[str, Number] = {"psnr_train_lr": psnr_of(low, photo.image, photo.shown)}
    row |= {f"loss_{name}": value for name, value in u.losses.items()}
    return u.step, row | conflict_columns(conflict)


def view_at(s: TrainState) -> View:
    """The view of iteration t: every view once, in random order, then again in another."""
    epoch, position = divmod(s.t - 1, len(s.views))
    return s.views[_order_of_views(s.settings.seed, epoch, len(s.views))[position]]


@lru_cache(maxsize=1)  # an epoch's iterations ask for the same order
def _order_of_views(seed: int, epoch: int, n: int) -> list[int]:
    order: list[int] = torch.randperm(n, generator=generator_at(seed, epoch), device="cpu").tolist()
    return order


def enlarged(s: TrainState, rasterizer: Rasterizer, background: Color | None, camera: Camera, factor: int) -> Photo:
    """A render of the field, enlarged; see `Strategy.draw`."""
    with s.conductor.work_log.stage("pictures drawn"):
        image = s.field.render(over(rasterizer, background), camera, detail=False)
        network = network_of(s.conductor.sr) or Bicubic()
        large = network("a drawn picture", images.quantize(image.cpu()), factor) if factor > 1 else image
    return Photo(camera.scaled(factor), large.to(image.device))


def extra_steps(
    s: TrainState, rasterizer: Rasterizer, extra_views: Sequence[ExtraView], background: Color | None = None
) -> dict[str, Number]:  # fmt: skip
    """One step of the optimizer on the LR loss of each extra view, a picture that a strategy adds to the iteration's own view.

    Args:
        background: behind everything that is drawn; None: the rasterizer's.

    Returns:
        The column `EXTRA_LOSS` of the history; nothing without extra views.

    Raises:
        DivergedError: a loss or a gradient is not finite; its step is not made.
    """
    row: dict[str, Number] = {}
    for extra in extra_views:
        steps = s.optimizer.steps
        row |= learn_extra(s, rasterizer, ExtraViewInputs(s.t, extra, background))[1]
        s.optimizer.steps = steps  # the learning rates follow the iteration
    return row


@replayed
def learn_extra(s: TrainState, rasterizer: Rasterizer, inputs: ExtraViewInputs) -> tuple[None, dict[str, Number]]:
    """What an iteration does with an extra view."""
    θ, extra, where = s.field, inputs.view, f"t={inputs.t}, an extra view"
    with s.conductor.work_log.stage("extra views"):
        shot = θ.shot(over(rasterizer, inputs.background), extra.photo.camera)
        losses = s.conductor.extra_loss(shot.image, extra, inputs.t)
        if s.compiled_step is not None:
            (g,) = shot.gradients(losses.cotangents)
            require_finite_parts(where, g, None)
            s.compiled_step.step_extra(θ.raw(), shot, g, inputs.t)
        else:
            (grads,) = shot.vjp(losses.cotangents)
            require_finite(f"{where}: the gradient", grads)
            s.optimizer.step(θ.raw(), grads)
            θ.constrain()
    return None, {EXTRA_LOSS: losses.values["lr"]}


def _row(s: TrainState) -> dict[str, Number]:
    return {
        "t": float(s.t),
        "lambda_hr": s.conductor.objective.lambda_hr(s.t),
        "n_gaussians": float(len(s.field)),
        "detail_abs": deferred.scalar(s.field.detail.data.abs().mean()),
        **({"opacities_reset": 1.0} if s.reset_due(s.t) else {}),  # the curves mark it, as PSNR falls then
    }


def kernel_threads(state: TrainState, rasterizer: Rasterizer) -> AbstractContextManager[None]:
    """A context to train in: all threads go to the compiled kernels where these do nearly all of the work."""
    if rasterizer.traits.native_threads and state.compiled_step is not None:
        return native.kernel_threads(native.threads())
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
    """Iterate to the end; evaluate test views and save checkpoints on the way.

    Args:
        checkpoints: where to save; None saves nothing. config: what a resumed run must share.
        progress: called after each iteration.

    Raises:
        Interrupted: after a signal, once the step is done and saved.
        DivergedError: a loss, a gradient or a parameter became NaN or infinite.
        AnswerError: a strategy's answer to a hook is not valid.

    After any error, the state before the iteration is saved, unless the optimizer has already stepped.
    """
    settings = state.settings

    def save(*, waits: bool = True) -> Path | None:
        if checkpoints is None:
            return None
        with state.conductor.work_log.stage("checkpoints"):
            beside.finish()  # the one before
            current = state.checkpoint(config or {})
            if waits:
                return checkpoint.save(checkpoints, current, keep=settings.keep)
            beside(partial(checkpoint.save, keep=settings.keep), checkpoints, current.copied())
        return None

    if settings.replay or (settings.replay is None and state.device.type == "cuda"):
        state.replays = replays_for(state, rasterizer)
    clock = Clock(state.history_as_floats()[-1] if state.history else {})
    before = state.t - 1
    with deferred_signals() as pending, kernel_threads(state, rasterizer), files.Beside() as beside:
        while not state.ended:
            done = state.t
            beside.finish(waits=False)
            with _explained(state, None if checkpoints is None else save):
                iterate(state, rasterizer)
            ended = state.ended
            state.history[-1].update(clock.read())
            if settings.probe_every and (_passed(settings.probe_every, before, done) or ended):
                with clock.paused():
                    evaluate(state, scene, rasterizer, done)
            if progress is not None:
                progress(state)
            if pending:
                raise Interrupted(foremost(pending), f"before iteration {state.t}", save())
            if settings.checkpoint_every and _passed(settings.checkpoint_every, before, done) and not ended:
                save(waits=False)  # its file takes as long as hundreds of iterations on a GPU
            before = done
        saved = save()
        if pending:
            raise Interrupted(foremost(pending), "after the last iteration", saved)
    state.replays = None  # recordings keep the memory of iterations, which evaluation and pictures need
    state.history_as_floats()
    return state


@contextmanager
def _explained(state: TrainState, save: Callable[[], Path | None] | None) -> Iterator[None]:
    """A scope of one iteration, whose errors also say which iteration it was, and where the state before it is saved.

    Args:
        save: saves the state; None: nothing is saved.
    """
    t, steps, where = state.t, state.optimizer.steps, ""
    try:
        yield
    except Exception as error:
        if save is not None and state.optimizer.steps != steps:
            where = " Its step was made, so that its state is not saved."
        elif save is not None:
            with suppress(Exception):  # the first error is reported
                where = f" The state before that step is {save()}; fit.resume goes on from it."
        if isinstance(error, AnswerError):
            raise AnswerError(f"t={t}: {error}{where}") from error
        if isinstance(error, DivergedError):
            remedy = "Check that view's photos, or lower the learning rates."
            raise DivergedError(f"{error}{where} {remedy}") from error
        error.add_note(f"This was in iteration t={t}.{where}")  # e.g. of a strategy's own code
        raise


def _passed(every: int, before: int, t: int) -> bool:
    """Return True if a multiple of `every` lies in (before, t]: skips may jump over it."""
    return t // every > before // every
