"""For a loop that stays as it is: render both scales where the host renders one, and merge in the host's `backward()`.

One training iteration:

1. The host renders. The gate zᵗ is sampled, Î_HR is rendered and its gradients are taken. Each extra view is rendered and
   its gradient is taken. Then Î_LR is rendered with the same zᵗ and the same random numbers, and returned to the host.
2. The host calls `backward()` on its own loss, whatever it is: that is the LR side. When this pass ends, `.grad` of every
   parameter becomes the merged gradient. If a strategy has a densification score, the tensor that the densifier reads
   holds it; otherwise the densifier's statistic stays the host's own.
3. Gradient clipping, unscaling, the optimizer step and densification are the host's, in any order.
4. After the host's optimizer has stepped, it steps once more on the gradient of each extra view.

The merge runs at the end of `backward()`, not in an optimizer hook. Gradient clipping therefore sees the merged gradient,
optimizers other than `torch.optim.Optimizer` work, and so do hosts that densify before the step (3DGS) as well as hosts
that densify after it (gsplat).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, Final
from weakref import WeakMethod

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.gradients import conflict_columns
from clear_strategies.core.step import Step
from clear_strategies.core.view import View
from clear_strategies.data.scene import require_shown
from clear_strategies.errors import HostError, SettingError
from clear_strategies.kernels.merge import Colour
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.in_place import InPlaceMerge, RoutedGradients
from clear_strategies.merging.iteration import HrGradients
from clear_strategies.strategies.base import overrides
from integration.autograd_shot import AutogradShot, DrawnGradients, HostOutput, RenderAt, passes_to_parameters
from integration.densification import ScoreScaler, write_score
from integration.extra_steps import ExtraSteps
from integration.views import enlarged_mask, require_unique
from rasterizers.autograd import Drawing
from rasterizers.interface import Color

_log = logging.getLogger(__name__)
_LOGGED_EVERY: Final = 100  # merges between two lines of the log
_PATIENCE: Final = 10  # steps with a gradient of f_det, before a warning that none was made on it


class Attachment:
    """The strategies beside a host's training loop.

    Args:
        params: returns the leaves that the host optimizes, by gsplat's names (and "detail"). It is called at every
            iteration, since densifiers replace parameters.
        views: all training views. seed: of the strategies.
        poll_parents: called at every iteration. It returns parents[M] if the structure has changed since its last call (row i of
            every parameter now comes from row parents[i]); None: it has not, or the host does not say how.
        restart_parents: called where the host has loaded other parameters, which come from no earlier ones.
        threshold: the host's densification threshold on the mean ‖∇_u‖ in NDC units; None: the score is not scaled.
        loss_scale: returns the factor of the host's loss (`scaler.get_scale` of an AMP gradient scaler).
        accumulation: backward passes per optimizer step, each of 1/accumulation of the loss.
        masks: [h, w] by the name of a view, what the host multiplies its LR image by; the HR image is multiplied here.
        own_background: the host chooses the colour behind its renderings; `background` then counts for nothing.
        reads_score: the host's densifier reads the screen gradient.

    Attributes:
        t: the current iteration, from 1.
        counts: how often each kind of work was done.
        removed: whether `remove` was called.
    """

    def __init__(
        self,
        conductor: Conductor,
        params: Callable[[], Mapping[str, Tensor]],
        *,
        views: Sequence[View],
        poll_parents: Callable[[], Int[Tensor, " M"] | None],
        restart_parents: Callable[[], None] = lambda: None,
        seed: int = 0,
        threshold: float | None = None,
        loss_scale: Callable[[], float] | None = None,
        accumulation: int = 1,
        masks: Mapping[str, Tensor] | None = None,
        own_background: bool = True,
        reads_score: bool = True,
    ) -> None:
        _require_supported(conductor, accumulation)
        require_unique(view.name for view in views)
        require_shown(views)
        self._views = {view.name: view for view in views}
        self.conductor, self.params, self.accumulation = conductor, params, accumulation
        self._masks, self._own_background, self._reads_score = dict(masks or {}), own_background, reads_score
        self.t = 1
        self.counts: Counter[str] = Counter()
        self.removed = False
        self._poll_parents, self._restart_parents, self._loss_scale = poll_parents, restart_parents, loss_scale
        self._scaler = None if threshold is None else ScoreScaler(threshold)
        self._n = len(params()["means"])
        self._passes = 0  # backward passes of this iteration
        self._merges_before_step = 0  # at the host's last step
        self._detail_gradients = 0
        # What is rendered and not merged yet.
        self._pending: tuple[int, HostOutput, HrGradients[DrawnGradients] | None, RoutedGradients | None] | None = None
        self._merge_in_place = InPlaceMerge(conductor)
        self._step: Step | None = None  # of the rendering, until `after_step`
        self._extra = ExtraSteps(conductor, params)
        self._grads_before: dict[str, Tensor] = {}  # .grad when the backward pass began
        self._versions_before: list[tuple[int, int]] = []
        self._logged: dict[str, deferred.Number] = {}
        self._hooks: list[Any] = []
        conductor.on_fit_start(len(views), seed, params()["means"].device, views)
        _announce(conductor, views, own_background=own_background)

    def render_view(self, view: View, render_at: RenderAt) -> Any:
        """Render a training view at both scales; returns what the host's render function returns at LR."""
        self._finish_previous_step()
        conductor, t, means = self.conductor, self.t, self.params()["means"]
        conductor.forget_logs()
        z = conductor.gate(t, self._n)
        if z is not None:
            z = z.to(means)
        hr = routed = None
        if conductor.wants_hr(t):
            self.counts["HR renders"] += 1
            view = conductor.skips.view(view, t)
            with _random_state_kept(means.device):
                shot = render_at("hr", z, view).shot
            if len(shot.drawings) > 1:
                self._count_parts(len(shot.drawings))
            if (mask := self._masks.get(view.name)) is not None:
                shot = replace(shot, image=shot.image * enlarged_mask(mask.to(shot.image), view.factor)[..., None])
            hr = conductor.hr_gradients(
                shot, view, t, AutogradShot.gradients, apart=shot.drawing is not None or "detail" in shot.params
            )
            if conductor.objective.lambda_hr(t) > 0:
                routed = shot.routed(hr, conductor.objective.lambda_hf)
        self._step = Step(t, view) if hr is None else hr.step
        if self._passes == 0:  # one step of the host, however many passes it accumulates
            self._extra.forget()
            if extra_views := conductor.extra_views(t):
                with _random_state_kept(means.device):
                    self._extra.render(extra_views, t, lambda camera: render_at(camera, None, view).shot)
        output = render_at("lr", z, view)
        self.counts["LR renders"] += 1
        if output.hooked.requires_grad:
            self._pending = (nth := self.counts["LR renders"]), output, hr, routed
            self._take_colours(output.shot.drawing, nth)
            output.hooked.register_hook(_called_at(WeakMethod(self._on_backward), nth))  # type: ignore[no-untyped-call]
        return output.returned

    def _take_colours(self, drawing: Drawing | None, nth: int) -> None:
        """Take the LR gradient of the colours by its factors, past the host's own copies of them, where the pass that is merged
        would only pass it on to the parameters.
        """
        params = self.params()
        if drawing is None or not (
            self._merge_in_place.takes_factors(params) and passes_to_parameters(drawing, params)
        ):
            return
        leaves = [torch.autograd.graph.get_gradient_edge(params[name]).node for name in ("sh0", "shN")]
        is_pending = WeakMethod(self._is_pending)  # the drawing must not hold what holds it, see `_called_at`
        drawing.colour.taken = lambda: (
            (alive := is_pending()) is not None and alive(nth) and all(map(_is_accumulated, leaves))
        )

    def _is_pending(self, nth: int) -> bool:
        return self._pending is not None and self._pending[0] == nth

    def _count_parts(self, n: int) -> None:
        self.counts["HR renders in parts"] += 1
        if self.counts["HR renders in parts"] == 1:
            _log.info(
                "The host calls its rasterizer %d times for one rendering, so each of the two HR gradients needs a backward "
                "pass of its own: with 46,000 Gaussians a step takes 1.4 times as long. Call it under torch.no_grad() for "
                "what is only looked at, and outside of the wrapped function for what only the LR loss needs.", n,
            )  # fmt: skip

    @property
    def background(self) -> Color | None:
        """The colour behind every rendering of this iteration, for hosts that let the strategies choose it; None: their own."""
        return None if self._own_background else self.conductor.background(self.t)

    def hook(self, optimizers: Sequence[torch.optim.Optimizer]) -> None:
        """Hook the steps of the host's optimizers, and no longer those of earlier ones. The first steps once an iteration."""
        for hook in self._hooks:
            hook.remove()
        distinct = list(dict.fromkeys(optimizers))  # one optimizer may have several parameters
        self._hooks = [
            *(o.register_step_pre_hook(lambda *_: self._before_step()) for o in distinct[:1]),
            *(o.register_step_post_hook(lambda o, *_: self._step_on_extra_views(o)) for o in distinct),
        ]

    def state_dict(self) -> dict[str, Any]:
        """The iteration, and what the strategies store per Gaussian, for the host's checkpoint."""
        if not self.removed:
            self._resize(len(self.params()["means"]))  # the host may have densified since it rendered
        return {
            "t": self.t, "passes": self._passes, "strategies": self.conductor.state_dict(),
            "view": None if self._step is None else self._step.view.name,
            "score": None if self._scaler is None else self._scaler.state_dict(),
        }  # fmt: skip

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state; the host has loaded its parameters already."""
        self.t, self._passes = int(state["t"]), int(state["passes"])
        self.conductor.load_state_dict(state["strategies"])
        self._restart_parents()
        self._n = len(self.params()["means"])
        if (view := self._views.get(state.get("view") or "")) is not None:
            self._step = Step(self.t, view)
        if self._scaler is not None and state.get("score") is not None:
            self._scaler.load_state_dict(state["score"])

    def summary(self) -> str:
        """What was done how often, e.g. for the end of a log."""
        return ", ".join(f"{n:,} {what}" for what, n in self.counts.items()) or "nothing was done"

    @property
    def log(self) -> dict[str, float]:
        """Scalars of the last iteration. On a device, reading them waits for the device."""
        return deferred.resolve([self._logged | self.conductor.logs()])[0]

    def remove(self) -> None:
        """Stop: the host's renderings pass through, and the gradients of one that is still pending stay unmerged."""
        self.removed, self._pending = True, None
        self.hook([])
        self._extra.forget()
        self.conductor.on_fit_end()

    def _before_step(self) -> None:
        """Count the steps in which no strategy took part."""
        if self._extra.stepping:
            return
        merges = self.counts["merges"]
        if not merges:
            raise HostError(
                "the host makes its first optimizer step, but none of its renderings was recognised as that of a training "
                "view, so that no strategy would take part. Check that the training loop renders with the function that "
                "was replaced, and with the cameras that were passed."
                if self._pending is None
                else "the host makes its first optimizer step, but no backward() has given the Gaussians a gradient, so that no "
                "strategy would take part. Take the gradients by loss.backward(), not by torch.autograd.grad."
            )
        if merges == self._merges_before_step:
            self.counts["steps of the host alone"] += 1
        self._merges_before_step = merges

    def _step_on_extra_views(self, optimizer: torch.optim.Optimizer) -> None:
        if not self._extra.stepping and (steps := self._extra.step(optimizer)):
            self.counts["extra views"] += steps

    def _finish_previous_step(self) -> None:
        """Call `on_resize` and `after_step`, now that the host has stepped and perhaps densified."""
        params = self.params()
        self._resize(len(params["means"]))
        if self._passes >= self.accumulation:
            if self._step is not None:
                self.conductor.after_step({name: p.detach() for name, p in params.items()}, self._step)
            self.t += 1
            self._passes = 0

    def _resize(self, n: int) -> None:
        """Gather the strategies' per-Gaussian state if the structure has changed."""
        parents = self._poll_parents()
        if parents is None and n == self._n:
            return
        state = ", ".join(self.conductor.state_dict())
        if self._step is not None:  # without parents, what it holds per Gaussian cannot be gathered
            self._step = Step(self._step.t, self._step.view) if parents is None else self._step.resized(parents)
        if parents is not None:
            self.conductor.on_resize(parents)
        elif state:
            # SVS raises an AnchorError here, which says more: the anchor's iteration, and the setting to change.
            self.conductor.on_resize(torch.zeros(n, dtype=torch.long))
            raise HostError(
                f"the number of Gaussians changed from {self._n:,} to {n:,} and the host does not say which came from "
                f"which, but {state} is stored per Gaussian. End densification first, or pass the host's state."
            )
        self.counts["structure changes"] += 1
        self._n = n

    def _on_backward(self, nth: int) -> None:
        """The host's backward pass has reached Î_LR of the nth rendering, but no parameter yet."""
        if self._pending is None:
            return
        if nth != self._pending[0]:
            raise HostError(
                "one backward pass reaches two renderings of training views, but each is merged by itself. With several views "
                "for a step, call backward() after each rendering and set accumulation=, or use joint_loss. For a second pass "
                "over the same view, call the function that was wrapped, its __wrapped__."
            )
        self._grads_before = {name: p.grad.clone() for name, p in self.params().items() if p.grad is not None}
        self._versions_before = self._grad_versions()
        centres = self._pending[1].shot.gradient_slot.tensor
        screen_gradients: list[Tensor] = []
        hook: Any = None
        if self._reads_score and centres.requires_grad:
            hook = centres.register_hook(screen_gradients.append)  # type: ignore[no-untyped-call]

        def on_backward_end() -> None:
            if hook is not None:
                hook.remove()
            self._merge(screen_gradients[0] if screen_gradients else None)

        torch.autograd.Variable._execution_engine.queue_callback(on_backward_end)

    @torch.no_grad()
    def _merge(self, screen_gradient: Tensor | None) -> None:
        """The host's backward pass has ended: replace its gradients by the merged ones.

        A pass that leaves every `.grad` as it was (`torch.autograd.grad`, `backward(inputs=…)`) asks for something else.
        """
        if self._pending is None or ((versions := self._grad_versions()) and versions == self._versions_before):
            return
        (_, output, hr, routed), self._pending = self._pending, None
        params = self.params()
        for name, p in params.items():
            if p.grad is not None and p.grad.is_sparse:
                raise HostError(
                    f"{name}.grad is sparse, but the gradients of all Gaussians are merged. In gsplat: "
                    "rasterization(sparse_grad=False)."
                )
        scale = (self._loss_scale() if self._loss_scale is not None else 1.0) / self.accumulation
        drawing = output.shot.drawing
        lr_colour = None if drawing is None or drawing.colour.factors is None else Colour(*drawing.colour.factors)
        conflict = self._merge_in_place(
            params, routed, self.t, before=self._grads_before, lr_colour=lr_colour, scale=scale,
            must_be_finite=self._loss_scale is None,
        )  # fmt: skip
        if "detail" in params and hr is not None and hr.hf is not None:
            self._decay_detail(params["detail"])
        if screen_gradient is not None and hr is not None:
            scores = partial(self.conductor.scores, hr=hr, weights=self.conductor.objective.weights(self.t))
            if write_score(output.shot, screen_gradient / scale, scores, self._scaler, scale):
                self.counts["scores written"] += 1
        self._grads_before = {}
        self._passes += 1
        self.counts["merges"] += 1
        λ = self.conductor.objective.lambda_hr(self.t)
        losses = {} if hr is None else hr.losses
        self._logged = {"t": float(self.t), "lambda_hr": λ, **losses, **conflict_columns(conflict)}
        if self.counts["merges"] % _LOGGED_EVERY == 0:
            now = self.log
            losses_now = ", ".join(f"L_{name} {now[name]:.4f}" for name in losses) or "no HR"
            _log.info("t=%d: %s, lambda_HR %.3f, %s Gaussians.", self.t, losses_now, λ, f"{self._n:,}")

    def _decay_detail(self, detail: Tensor) -> None:
        """L_HF does not change with a constant added to the colours, so that nothing else would hold the mean of f_det."""
        rates = self.conductor.detail
        detail.mul_(1 - rates.decay / self.accumulation)
        if self.conductor.objective.lambda_hr(self.t) == 0:
            return
        self._detail_gradients += 1
        if self._detail_gradients == _PATIENCE * self.accumulation and rates.rate > 0 and not bool(detail.any()):
            _log.warning(
                "f_det has no effect: none of its first %d gradients was stepped on. Step the optimizer of the parameter detail; "
                "attach adds it to the dictionary of optimizers.", _PATIENCE,
            )  # fmt: skip

    def _grad_versions(self) -> list[tuple[int, int]]:
        """What changes with every gradient of the Gaussians; empty where all of them are frozen."""
        trained = [p.grad for name, p in self.params().items() if p.requires_grad and name != "detail"]
        return [(0, 0) if g is None else (id(g), g._version) for g in trained]


def _require_supported(conductor: Conductor, accumulation: int) -> None:
    """Raise a SettingError for what no host can do."""
    if accumulation < 1:
        raise SettingError(f"accumulation: must be at least 1 backward pass per step, got {accumulation}.")
    if not conductor.wants_lr:
        raise SettingError(
            "objective: a host renders LR itself, so lambda_lr must be > 0 and lr_from must be lr, got "
            f"lambda_lr={conductor.objective.lambda_lr}, lr_from={conductor.objective.lr_from!r}."
        )
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized() and (n := distributed.get_world_size()) > 1:
        raise SettingError(f"CLEAR trains in one process, got {n}. Start the training without torchrun, on one device.")


def _announce(conductor: Conductor, views: Sequence[View], *, own_background: bool) -> None:
    """Log what each strategy will do, and which have no effect. After `on_fit_start`.

    Args:
        own_background: the host chooses its background by itself.
    """
    for s in conductor.strategies:
        if (prepared := s.summary()) is not None:
            _log.info("%s: %s.", type(s).__name__, prepared)
    if not conductor.decorated and any(view.factor > 1 for view in views):
        _log.warning(
            "%s has no effect: the views were made without it. Make them with sr=conductor.prior(sr).",
            ", ".join(getattr(getattr(d, "func", d), "__name__", str(d)) for d in conductor.decorators),
        )
    for phrase in conductor.skips.descriptions(views, in_host=True):
        _log.info("Skipped: %s.", phrase)
    for hook, reason in {
        "densifier": "keeps its own density control",
        "drawn_views": "draws no picture for it",
        **({"background": "chooses its background itself"} if own_background else {}),
    }.items():
        for owner in (s for s in conductor.strategies if overrides(s, hook)):
            _log.info("%s has no effect here: the host %s.", type(owner).__name__, reason)
    if not conductor.strategies:
        _log.info("no strategy is attached: both losses are summed, as in the paper's baseline.")


def _called_at(on_backward: WeakMethod[Callable[[int], None]], nth: int) -> Callable[[Tensor], None]:
    """A tensor hook that calls `on_backward(nth)`. Its reference is weak: with a strong one, its tensor would never be freed."""
    return lambda _: None if (alive := on_backward()) is None else alive(nth)


def _is_accumulated(leaf: Any) -> bool:
    """Whether the backward pass under way adds to a leaf's `.grad`; `torch.autograd.grad` returns its gradient instead."""
    try:
        return bool(torch._C._will_engine_execute_node(leaf))
    except RuntimeError:  # what torch does in a pass of `torch.autograd.grad` for this leaf
        return False


@contextmanager
def _random_state_kept(device: torch.device) -> Iterator[None]:
    """Restore torch's random generators, so that a dropout inside the host's render drops the same at both scales."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        yield
