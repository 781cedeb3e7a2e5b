"""For a loop that stays as it is: render both scales where the host renders one, and merge in the host's `backward()`.

One training iteration:

1. The host renders. The gate zᵗ is sampled, Î_HR is rendered and its gradients are taken. Each extra view is rendered and
   its gradient is taken. Then Î_LR is rendered with the same zᵗ and the same random numbers, and returned to the host.
2. The host calls `backward()` on its own loss, whatever it is: that is the LR side. When this pass ends, `.grad` of every
   parameter becomes the merged gradient. If a strategy has a densification score, the tensor that the densifier reads
   holds it; otherwise the densifier's statistic stays the host's own.
3. Gradient clipping, unscaling, the optimizer step and densification are the host's, in any order.
4. After the host's optimizer has stepped, it steps once more on the gradient of each extra view. Once all optimizers have
   stepped, the strategies do what they do after a step.

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
from weakref import WeakMethod, finalize

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Grads, conflict_columns
from clear_strategies.core.step import Step
from clear_strategies.core.view import ExtraView, View
from clear_strategies.data.scene import require_shown
from clear_strategies.errors import HostError, SettingError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.in_place import merge_in_place
from clear_strategies.merging.iteration import HrSide
from clear_strategies.strategies.base import overrides
from clear_strategies.strategies.sr_stage import SRStage
from integration.autograd_shot import AutogradShot
from integration.densification import ScoreScaler, write_score
from integration.detail import Fading
from integration.extra_steps import ExtraSteps
from integration.own_drawing import Drawable, OwnDrawing, RenderAt
from integration.pending import BackwardPass, Pending, current_pass
from integration.replayed_merge import ReplayedMerge
from integration.views import enlarged_mask, require_unique
from rasterizers.autograd import TakeColours
from rasterizers.interface import Color

_log = logging.getLogger(__name__)
_LOGGED_EVERY: Final = 100  # merges between two lines of the log
_STRETCH: Final = "Make the conductor for the length of the loop: conductor(…, iterations=…)."


class Attachment:
    """The strategies beside a host's training loop.

    Args:
        params: returns the leaves that the host optimizes, by gsplat's names (and "detail"). It is called at every
            iteration, since densifiers replace parameters.
        views: all training views. seed: of the strategies.
        poll_parents: called at every iteration. It returns parents[M] if the structure has changed since its last call (row i of
            every parameter now comes from row parents[i], or from none where that is -1); None: it has not, or the host does
            not say how.
        remedy: what to do in this host about Gaussians that come from no other, where strategies store something of each.
        restart_parents: called where the host has loaded other parameters, which come from no earlier ones.
        threshold: the host's densification threshold on the mean ‖∇_u‖ in NDC units; None: the score is not scaled.
        loss_scale: returns the factor of the host's loss (`scaler.get_scale` of an AMP gradient scaler).
        accumulation: backward passes per optimizer step, each of 1/accumulation of the loss.
        masks: [h, w] by the name of a view, what the host multiplies its LR image by; the HR image is multiplied here.
        own_background: the host chooses the colour behind its renderings; `background` then counts for nothing.
        reads_score: the host's densifier reads the screen gradient.
        iterations: of the loop, where they are known.

    Attributes:
        t: the current iteration, from 1.
        passes: its backward passes so far.
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
        remedy: str = "End densification first.",
        seed: int = 0,
        threshold: float | None = None,
        loss_scale: Callable[[], float] | None = None,
        accumulation: int = 1,
        masks: Mapping[str, Tensor] | None = None,
        own_background: bool = True,
        reads_score: bool = True,
        iterations: int | None = None,
    ) -> None:
        _require_supported(conductor, accumulation)
        require_unique(view.name for view in views)
        require_shown(views)
        self._views = {view.name: view for view in views}
        self.conductor, self.params, self.accumulation = conductor, params, accumulation
        self._masks, self._own_background, self._reads_score = dict(masks or {}), own_background, reads_score
        self.t, self.passes = 1, 0
        self.counts: Counter[str] = Counter()
        self.removed = False
        self._poll_parents, self._restart_parents, self._remedy = poll_parents, restart_parents, remedy
        self._loss_scale = loss_scale
        self._scaler = None if threshold is None else ScoreScaler(threshold)
        self._n = len(params()["means"])
        self._fading = Fading(conductor.detail, accumulation)
        self._pending: Pending | None = None  # the last rendering
        self._pass: BackwardPass | None = None  # the last one that has reached a rendering
        self._merge_in_place: Callable[..., Mapping[str, deferred.Number]] = partial(
            merge_in_place, conductor, merge=ReplayedMerge(conductor, params()["means"].device)
        )
        self._step: Step | None = None  # of the rendering, until `after_step`
        self._extra = ExtraSteps(params)
        self._logged: dict[str, deferred.Number | Callable[[], deferred.Number]] = {}
        self._own_drawing = OwnDrawing(conductor, params()["means"].device)
        self._hooks: list[Any] = []
        self._hooked: list[torch.optim.Optimizer] = []
        self._stepped: set[int] = set()  # the optimizers that have made this step of the host
        self._has_merged = False  # since the last step
        self._has_warned = self._has_told_of_accumulation = False
        conductor.on_fit_start(len(views), seed, params()["means"].device, views)
        _announce(conductor, views, own_background=own_background, iterations=iterations)
        self._farewell = finalize(self, _warn_without_hr, self.counts, first_hr(conductor))

    def render_view(self, view: View, render_at: RenderAt) -> Any:
        """Render a training view at both scales; returns what the host's render function returns at LR."""
        self._finish_step()  # where not every optimizer has stepped, or the structure has changed since
        conductor, t, params = self.conductor, self.t, {name: p.detach() for name, p in self.params().items()}
        means = params["means"]
        conductor.forget_logs()
        z = conductor.gate(t, self._n)
        if z is not None:
            z = z.to(means)
        hr = routed = None
        if self._wants_hr(t):
            self.counts["HR renders"] += 1
            view = conductor.skips.view(view, t)
            hr, routed = self._hr_side(view, t, z, render_at, params)
        self._step = Step(t, view, params=params) if hr is None else hr.step
        if self.passes == 0:  # one step of the host, however many passes it accumulates
            self._extra.forget()
            if extra_views := conductor.extra_views(t):
                self._extra.take(extra_views, lambda extra: self._of_extra(extra, view, t, render_at))
        output = render_at("lr", z, view)
        if isinstance(output, Drawable):
            raise TypeError("an adapter renders LR by the host's own function, got a Drawable.")
        self.counts["LR renders"] += 1
        self._pending = Pending(self.counts["LR renders"], view.name, output, hr, routed)
        scored = self._reads_score and hr is not None and conductor.owner("score") is not None
        self._pending.listen(WeakMethod(self._reached), to_screen=scored)
        return output.returned

    def _hr_side(
        self, view: View, t: int, z: Tensor | None, render_at: RenderAt, params: Mapping[str, Tensor]
    ) -> tuple[HrSide, Grads | None]:
        """The gradients of HR, and the same of the raw parameters where HR takes part in the merge."""
        conductor, mask, drawn = self.conductor, self._masks.get(view.name), render_at("hr", z, view)
        merges = conductor.objective.lambda_hr(t) > 0
        fine = None if mask is None else enlarged_mask(mask.to(params["means"]), view.factor)[..., None]
        if isinstance(drawn, Drawable):
            hr, routed = self._own_drawing.hr(drawn, view, t, fine)
            return hr, routed if merges else None
        shot = drawn.shot
        if len(shot.drawings) > 1:
            self._count_parts(len(shot.drawings))
        if fine is not None:
            shot = replace(shot, image=shot.image * fine.to(shot.image))
        apart = shot.drawing is not None or "detail" in shot.params
        hr = conductor.hr_gradients(shot, view, t, AutogradShot.gradients, apart=apart, params=params)
        return hr, shot.routed(hr, conductor.objective.lambda_hf) if merges else None

    def _of_extra(self, extra: ExtraView, view: View, t: int, render_at: RenderAt) -> Grads:
        """The gradient of an extra view."""
        drawn = render_at(extra.photo.camera, None, view)
        if isinstance(drawn, Drawable):
            return self._own_drawing.extra_view(drawn, extra, t)
        (g,) = drawn.shot.vjp(self.conductor.extra_loss(drawn.shot.image, extra, t).cotangents)
        return g

    def _wants_hr(self, t: int) -> bool:
        """Whether HR takes part at t. Where the host's densifier reads its score, no iteration is skipped."""
        conductor = self.conductor
        scores = self._reads_score and conductor.owner("score") is not None and conductor.may_densify(t)
        return conductor.wants_hr(t) and (scores or not conductor.skips.leaves_out_hr(t, conductor.work_log))

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
        """Hook the steps of the optimizers that the host now has, and no longer those of earlier ones."""
        distinct = list(
            {id(o): o for o in optimizers if isinstance(o, torch.optim.Optimizer)}.values()
        )  # others have no hooks
        if list(map(id, distinct)) == list(map(id, self._hooked)):
            return
        for hook in self._hooks:
            hook.remove()
        self._hooked = distinct
        self._stepped.clear()
        self._hooks = [
            *(
                o.register_step_pre_hook(lambda o, given, named: self._before_step(o, *given, *named.values()))
                for o in distinct
            ),
            *(o.register_step_post_hook(lambda o, *_: self._after_step_of(o)) for o in distinct),
        ]

    def state_dict(self) -> dict[str, Any]:
        """The iteration, and what the strategies store per Gaussian, for the host's checkpoint."""
        if not self.removed:
            self._resize(len(self.params()["means"]))  # the host may have densified since it rendered
        return {
            "t": self.t, "passes": self.passes, "strategies": self.conductor.state_dict(),
            "view": None if self._step is None else self._step.view.name, "step": _rows_of(self._step),
            "score": None if self._scaler is None else self._scaler.state_dict(),
        }  # fmt: skip

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state; the host has loaded its parameters already."""
        self.t, self.passes = int(state["t"]), int(state["passes"])
        self.conductor.load_state_dict(state["strategies"])
        self._restart_parents()
        self._n = len(self.params()["means"])
        if (view := self._views.get(state.get("view") or "")) is not None:  # its `after_step` is still to come
            rows = {name: x.to(self.params()["means"].device) for name, x in state.get("step", {}).items()}
            evidence = Evidence(rows["reliability"], rows["demand"]) if "demand" in rows else None
            self._step = Step(self.t, view, rows.get("visible"), evidence)
        if self._scaler is not None and state.get("score") is not None:
            self._scaler.load_state_dict(state["score"])

    def summary(self) -> str:
        """What was done how often, e.g. for the end of a log."""
        return ", ".join(f"{n:,} {what}" for what, n in self.counts.items()) or "nothing was done"

    @property
    def log(self) -> dict[str, float]:
        """Scalars of the last iteration that was merged. On a device, reading them waits for the device."""
        return deferred.resolve([{name: x() if callable(x) else x for name, x in self._logged.items()}])[0]

    def remove(self) -> None:
        """Stop: the host's renderings pass through, and the gradients of one that is still pending stay unmerged."""
        self.removed, self._pending, self._pass = True, None, None
        self.hook([])
        self._extra.forget()
        self.conductor.on_fit_end()
        self._farewell()

    def _before_step(self, optimizer: torch.optim.Optimizer, *given: Any) -> None:
        """Refuse a first step in which no strategy takes part, and tell of a later one.

        Args:
            given: what `step` was called with.
        """
        if self._extra.stepping:
            return
        if any(callable(x) for x in given):
            raise HostError(
                "the host gives its optimizer a closure, which renders inside of step(), but the gradients are merged before. "
                "Render and call loss.backward(), then step() without a closure."
            )
        if current_pass() >= 0 and self._pending is not None and self._pending.output is not None:
            raise HostError(
                "the host steps inside of its backward pass, where the gradients of the views are not merged yet. Step after "
                "loss.backward() has returned, not in a hook of a gradient."
            )
        if id(optimizer) in self._stepped:  # one step of the host is each optimizer once
            self._stepped.clear()
        begins = not self._stepped
        self._stepped.add(id(optimizer))
        if not begins:
            return
        has_merged, self._has_merged = self._has_merged, False
        if has_merged:
            self._fading.before_step()
            return
        trained = [name for name, p in self.params().items() if p.requires_grad and name != "detail"]
        cause = self._why_nothing_was_merged(trained)
        if not self.counts["merges"]:
            raise HostError(
                f"the host makes its first optimizer step, but {cause[0]}, so that no strategy would take part. {cause[1]}"
            )
        self.counts["steps of the host alone"] += 1
        if not self._has_warned:
            self._has_warned = True
            _log.warning(
                "the host makes a step in which no strategy takes part: %s, and %s changed without CLEAR or not at all. %s",
                cause[0], ", ".join(trained) or "nothing", cause[1],
            )  # fmt: skip

    def _why_nothing_was_merged(self, trained: Sequence[str]) -> tuple[str, str]:
        """The cause, and what to do."""
        pending = self._pending
        if not trained:
            return (
                "all parameters of the Gaussians are frozen",
                "Let those that should train require gradients, or remove() what was attached.",
            )
        if pending is None or pending.output is None:
            return (
                "none of its renderings was recognised as that of a training view",
                "Check that the training loop renders with the function that was replaced, and with the cameras that were "
                "passed. A loop with `attach` that moves its cameras names the view: with clear.rendering(view): …",
            )
        shot = pending.output.shot
        if (
            not any(x.requires_grad for drawing in shot.drawings for x in drawing.inputs.values())
            and not pending.output.marks
        ):
            return (
                f"the rendering of {pending.view} does not depend on {', '.join(trained)}",
                "Pass the function tensors that are made of the parameters, with gradients enabled and not detached.",
            )
        return (
            f"no backward() has given {', '.join(trained)} a gradient by the rendering of {pending.view}",
            "Take the gradients by loss.backward(), not by torch.autograd.grad, of a loss of that rendering.",
        )

    def _after_step_of(self, optimizer: torch.optim.Optimizer) -> None:
        """Step on extra views; and once all optimizers have stepped, let the strategies do so: what the loop computes of the
        parameters from then on, before it renders, is of what they have left. In the iteration in which densification ends they
        wait for the next rendering, since a host may densify in it, and an anchor is taken after that.
        """
        if self._extra.stepping:
            return
        if steps := self._extra.step(optimizer):
            self.counts["extra views"] += steps
        may_densify = self.conductor.may_densify
        if len(self._stepped) == len(self._hooked) and may_densify(self.t) == may_densify(max(1, self.t - 1)):
            self._finish_step()

    def _finish_step(self) -> None:
        """Call `on_resize` and `after_step`, now that the host has stepped and perhaps densified. Passes whose gradients the loop
        has dropped before it stepped, e.g. after an error, are of no iteration.
        """
        params = self.params()
        self._resize(len(params["means"]))
        if not self.passes:
            return
        has_stepped = bool(self._stepped) or self.passes >= self.accumulation  # a gradient scaler may skip the step
        if has_stepped:
            if self._step is not None:
                self.conductor.after_step({name: _to_change(p) for name, p in params.items()}, self._step)
            self.t += 1
        gradients = (p.grad for name, p in params.items() if name != "detail")  # which the host may know nothing of
        if has_stepped or not any(g is not None and bool(g.any()) for g in gradients):
            self.passes = 0
            self._fading.forget()

    def _resize(self, n: int) -> None:
        """Gather the strategies' per-Gaussian state if the structure has changed."""
        parents = self._poll_parents()
        if parents is None and n == self._n:
            return
        if parents is not None and len(parents) != n:
            raise HostError(f"the host says of {len(parents):,} Gaussians which they come from, but has {n:,}.")
        state = ", ".join(self.conductor.state_dict())
        if parents is not None and (unknown := int((parents < 0).sum())):
            if state:
                raise HostError(
                    f"{unknown:,} new Gaussians come from no other, but {state} is stored of each Gaussian. {self._remedy}"
                )
            parents = parents.clamp_min(0)
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

    def _reached(self, nth: int) -> TakeColours | None:
        """A backward pass of the host has reached the nth rendering, but no parameter yet."""
        if self.removed or self._pending is None:
            return None
        if self._pass is None or self._pass.task != current_pass():
            self._pass = now = BackwardPass(current_pass(), self.params())
            torch.autograd.Variable._execution_engine.queue_callback(lambda: self._on_backward_end(now))
        self._pass.renderings.add(nth)
        params = self._pass.params
        whole = not self._pending.may_take_factors(params)
        return None if whole else self._pass.take

    @torch.no_grad()
    def _on_backward_end(self, done: BackwardPass) -> None:
        """A backward pass of the host has ended: replace the gradients that it has brought by the merged ones.

        A pass that leaves every `.grad` as it was (`torch.autograd.grad`) asks for something else.
        """
        pending, self._pass = self._pending, None
        trained = {name for name, p in done.params.items() if p.requires_grad and name != "detail"}
        accumulated = done.accumulated()
        if pending is None or (trained and not accumulated):
            return
        pending.require_alone(done)
        using = [type(s).__name__ for s in map(self.conductor.owner, ("reconcile", "score")) if s is not None]
        pending.require_first(accumulated, " and ".join(using))
        if names := [name for name in accumulated if name not in pending.merged]:
            self._merge(pending, done, names)
        elif not trained and not pending.merged:
            self._merge(pending, done, [])
        if pending.merged >= trained:
            pending.output = pending.hr = pending.routed = None

    def _merge(self, pending: Pending, done: BackwardPass, names: Sequence[str]) -> None:
        hr, first = pending.hr, not pending.merged
        params = {name: done.params[name] for name in names}
        for name, p in params.items():
            if p.grad is not None and p.grad.is_sparse:
                raise HostError(
                    f"{name}.grad is sparse, but the gradients of all Gaussians are merged. In gsplat: "
                    "rasterization(sparse_grad=False)."
                )
            if (
                p.grad is not None and p.grad.requires_grad
            ):  # of create_graph=True, of which the merged gradient is no part
                p.grad = p.grad.detach()
        scale = (self._loss_scale() if self._loss_scale is not None else 1.0) / self.accumulation
        detail = done.params.get("detail") if first else None
        if detail is not None and not detail.requires_grad:
            detail = None
        if detail is not None:
            params["detail"] = detail
            if detail.grad is not None:  # what the host has given it stays
                done.before["detail"] = detail.grad
        conflict = self._merge_in_place(
            params, pending.routed_of(names, done.params), None if hr is None else hr.step, self.t,
            before=done.before, lr_colour=done.colour, scale=scale,
            must_be_finite=self._loss_scale is None,
        )  # fmt: skip
        pending.merged.update(names or ("detail",))
        if first and self.passes == 0 and not self._stepped:
            self._warn_of_accumulation([done.before[name] for name in names if name in done.before])
        self._stepped.clear()
        self._has_merged = True
        self.counts["merges"] += 1
        if not first:
            return
        self.passes += 1
        if detail is not None:
            self._finish_detail(detail, [done.params[name] for name in names], hr is not None and hr.hf is not None)
        if (screen := pending.screen.get(done.task)) is not None and pending.output is not None and hr is not None:
            scores = partial(self.conductor.scores, hr=hr, weights=self.conductor.objective.weights(self.t))
            if write_score(pending.output.shot, screen / scale, scores, self._scaler, scale):
                self.counts["scores written"] += 1
        λ = self.conductor.objective.lambda_hr(self.t)
        losses = {} if hr is None else hr.losses
        shares = conflict_columns(conflict)
        self._logged = {"t": float(self.t), "lambda_hr": λ, **losses, **shares, **self.conductor.uncounted_logs()}
        if self.counts["merges"] % _LOGGED_EVERY == 0:
            now = self.log
            losses_now = ", ".join(f"L_{name} {now[name]:.4f}" for name in losses) or "no HR"
            _log.info("t=%d: %s, lambda_HR %.3f, %s Gaussians.", self.t, losses_now, λ, f"{self._n:,}")

    def _warn_of_accumulation(self, before: Sequence[Tensor]) -> None:
        """Tell once that a step sums more passes than `accumulation` names.

        Args:
            before: the gradients to which the first of `accumulation` passes has added.
        """
        if self._has_told_of_accumulation or not self.counts["merges"] or not any(bool(g.any()) for g in before):
            return
        self._has_told_of_accumulation = True
        _log.warning(
            "%d backward passes over training views add to the same gradients, without an optimizer step between them, but "
            "accumulation=%d: HR weighs too much, and the schedules of the strategies end too early. Pass accumulation=n, the "
            "number of views in a step, and divide each loss by n.",
            self.accumulation + 1, self.accumulation,
        )  # fmt: skip

    def _finish_detail(self, detail: Tensor, others: Sequence[Tensor], by_hf: bool) -> None:
        """After the merge of f_det, which the host's optimizer steps as the others."""
        if self._loss_scale is not None and detail.grad is not None:
            # A gradient scaler asks each optimizer apart whether to step; 0 times a number that is not finite is not finite.
            for p in others:
                if p.grad is not None:
                    detail.grad += 0 * p.grad.sum(dtype=torch.float32)
        if by_hf:
            self._fading.add_pass(detail, is_learned=self.conductor.objective.lambda_hr(self.t) > 0)


def _to_change(p: Tensor) -> Tensor:
    """What a strategy may change in place: a copy, where the host has frozen the parameter. What a loop has computed of it before
    it renders stays valid for autograd.
    """
    return p.data if p.requires_grad else p.detach().clone()


def _rows_of(step: Step | None) -> dict[str, Tensor]:
    """What a step holds per Gaussian, for a checkpoint."""
    if step is None:
        return {}
    e, visible = step.evidence, {} if step.visible is None else {"visible": step.visible}
    return visible | ({} if e is None else {"reliability": e.reliability, "demand": e.demand})


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


def first_hr(conductor: Conductor) -> int | None:
    """The first iteration in which HR takes part in the gradient; None: in none."""
    λ = conductor.objective.lambda_hr
    return λ.start + 1 if λ.peak > 0 else λ.decay_from + 1 if λ.final > 0 else None


def _warn_without_hr(counts: Counter[str], first: int | None) -> None:
    """At the end of a loop."""
    if first is not None and 0 < counts["merges"] < first and not counts["HR renders"]:
        _log.warning(
            "HR took no part in the %d steps of this loop: it would from step %d on. %s",
            counts["merges"],
            first,
            _STRETCH,
        )


def _announce(conductor: Conductor, views: Sequence[View], *, own_background: bool, iterations: int | None) -> None:
    """Log what each strategy will do, and which have no effect. After `on_fit_start`.

    Args:
        own_background: the host chooses its background by itself. iterations: of the loop, where they are known.
    """
    if (first := first_hr(conductor)) is not None:
        _log.info("HR takes part from step %d on (objective.lambda_hr.start).", first)
        if iterations is not None and first > iterations:
            _log.warning("HR takes part from step %d on, but the loop has %d steps. %s", first, iterations, _STRETCH)
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
        **({"background": "chooses its background itself"} if own_background else {}),
    }.items():
        for owner in (s for s in conductor.strategies if overrides(s, hook)):
            _log.info("%s has no effect here: the host %s.", type(owner).__name__, reason)
    for stage in (s for s in conductor.strategies if isinstance(s, SRStage)):
        _log.info("%s has no effect here: the host draws no picture for it.", type(stage).__name__)
    if not conductor.strategies:
        _log.info("no strategy is attached: both losses are summed, as in the paper's baseline.")


@contextmanager
def random_state_kept(device: torch.device) -> Iterator[None]:
    """Restore torch's random generators after a host has drawn HR or an extra view, so that a dropout inside its function drops
    the same at LR.
    """
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        yield
