"""For a loop that stays as it is: render both scales where the host renders one, and merge in the host's `backward()`.

One training iteration:

1. The host renders. The gate zᵗ is sampled, Î_HR is rendered and its gradients are taken. Each extra view is rendered and
   its gradient is taken. Then Î_LR is rendered with the same zᵗ and the same random numbers, and returned to the host.
2. The host calls `backward()` on its own loss, which is the LR side. When this pass ends, `.grad` of every parameter becomes
   the merged gradient. If a strategy has a densification score, it is written to the tensor that the densifier reads;
   otherwise the densifier's statistic stays the host's own.
3. Gradient clipping, unscaling, the optimizer step and densification are the host's, in any order.
4. After the host's optimizer has stepped, it steps once more on the gradient of each extra view. Once all optimizers have
   stepped, `after_step` of the strategies is called.

What the adapter tells of the host is in host.py, HR and extra views in hr_drawing.py, what waits for `backward()` in
pending.py, the backward passes and their merge in host_merge.py, the optimizers' steps in host_steps.py, changes of the structure
in structure.py, what is read of the host's autograd graph in graph.py, and the first lines of the log in announcement.py.

The merge runs at the end of `backward()`, not in an optimizer hook. Gradient clipping therefore sees the merged gradient,
optimizers other than `torch.optim.Optimizer` work, and so do hosts that densify before the step (3DGS) as well as hosts
that densify after it (gsplat).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Final, cast
from weakref import finalize

import torch
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import conflict_columns
from clear_strategies.core.step import Step
from clear_strategies.core.view import View
from clear_strategies.data.scene import require_shown
from clear_strategies.errors import HostError, SettingError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.logs import computed
from clear_strategies.strategies.base import Logged
from integration.announcement import Once, announce, last_error, warn_without_hr
from integration.autograd_shot import HostOutput, OfOthers, Target, require_named, trained
from integration.graph import require_in_order
from integration.host import Host
from integration.host_merge import HostMerge
from integration.host_steps import HostSteps, stepping_scaler
from integration.hr_drawing import Drawable, HrDrawing, RenderAt
from integration.pending import Pending, why_nothing_was_merged
from integration.structure import resized
from integration.views import require_unique
from rasterizers.interface import Color
from rasterizers.modes import on_cpu_by_default
from rasterizers.torch_internals import current_pass

_log = logging.getLogger(__name__)
_LOGGED_EVERY: Final = 100  # merges between two lines of the log


class Attachment:
    """The strategies beside a host's training loop.

    Args:
        host: what the adapter knows of the loop.
        views: all training views. seed: of the strategies.

    Attributes:
        t: the current iteration, from 1.
        passes: backward passes since the last step of the host, whose gradients it has kept.
        counts: how often each kind of work was done.
        removed: whether `remove` was called.
        undo: callbacks of `remove`, by which an adapter undoes its changes to the host.
    """

    @on_cpu_by_default
    def __init__(self, conductor: Conductor, host: Host, views: Sequence[View], *, seed: int = 0) -> None:
        _require_supported(conductor)
        require_unique(view.name for view in views)
        require_shown(views)
        self.conductor = conductor
        self.t = 1
        self.passes = 0
        self.counts: Counter[str] = Counter()
        self.removed = False
        self.undo = ExitStack()
        self._warn_once = Once(_log.warning)
        self._host = host
        means = host.leaves()["means"]
        self._n = len(means)
        self._hr = HrDrawing(conductor, host, means.device, self.counts)
        self._merging = HostMerge(conductor, host, means.device, self.counts, self._merged)
        self._steps = HostSteps(self._before_optimizer, self._step_begins, self._after_optimizer, self.counts)
        self._step: Step | None = None  # of the rendering, until `after_step`
        self._logged: dict[str, Logged] = {}
        self._dropped = False  # the last pass found that the loop had dropped the gradients of those before
        self._learning: Tensor | None = None  # until the first step: rows with a gradient of means
        conductor.on_fit_start(len(views), seed, means.device, views)
        self._run = conductor.run
        announce(conductor, views, host)
        self._finalizer = finalize(self, warn_without_hr, conductor, self.counts, last_error())

    def render_view(self, view: View, render_at: RenderAt) -> Any:
        """Render a training view at both scales; returns what the host's render function returns at LR.

        Raises:
            HostError: a backward pass is running; `render_at` renders other parameters, or its Gaussians in another order.
            StrategyConflict: the conductor or one of its strategies has begun another run.
            SettingError: several processes train.
        """
        if self.removed:
            return cast(HostOutput, render_at("lr", None, view)).returned
        _require_one_process()
        if current_pass() >= 0:
            raise HostError(
                f"{view.name} is rendered inside of a backward pass, as torch.utils.checkpoint does it: HR would be drawn twice, "
                "and the loss be that of another picture. Checkpoint what comes before the rendering, or after it."
            )
        self.conductor.require_run(self._run)
        self._finish_step(view)  # not every optimizer may have stepped, and the structure may have changed
        conductor, t, leaves = self.conductor, self.t, self._host.leaves()
        render_at = _checked(render_at, leaves)
        params = {name: p.detach() for name, p in leaves.items()}
        means = params["means"]
        z = conductor.gate(t, self._n)
        if z is not None:
            z = z.to(means)
        # HR and extra views leave torch's random numbers as they were, so a dropout of the host drops the same at LR.
        apart = torch.random.fork_rng([means.device] if means.device.type == "cuda" else [])(render_at)
        hr, step = None, Step(t, view, params=params)
        others: OfOthers = []
        if self._hr.wanted(t):
            view = conductor.skips.view(view, t)
            hr, others = self._hr.hr(replace(step, view=view), z, apart)
        self._step = step if hr is None else hr.step
        if self.passes == 0 or self._dropped or not self._steps.has_extra_views:  # once for all passes of a step
            extra_views = conductor.extra_views(t)
            self._steps.follow_by(leaves, (self._hr.extra_view(x, view, t, apart) for x in extra_views))
        output = cast(HostOutput, render_at("lr", z, view))
        require_in_order(view.name, output.shot.inputs, output.shot.params)
        self.counts["LR renders"] += 1
        pending = Pending(self.counts["LR renders"], t, view.name, output, hr, others)
        self._merging.await_passes(pending, to_screen=hr is not None and self._hr.is_scored)
        return output.returned

    @property
    def background(self) -> Color | None:
        """The colour behind every rendering of this iteration, for hosts that let the strategies choose it; None: their own."""
        return None if self._host.own_background else self.conductor.background(self.t)

    def hook(self, optimizers: Sequence[torch.optim.Optimizer]) -> None:
        """Hook the steps of these optimizers, and remove the hooks of earlier ones."""
        self._steps.hook(optimizers)

    def state_dict(self) -> dict[str, Any]:
        """The iteration and the strategies' state, for the host's checkpoint."""
        if not self.removed:
            self._follow_structure(len(self._host.leaves()["means"]))  # the host may have densified since it rendered
        return {
            "t": self.t, "passes": self.passes, "passes_with_hr": self._merging.fading.passes,
            "by_hand": self._steps.by_hand,
            "strategies": self.conductor.state_dict(),
            "view": None if self._step is None else self._step.view.name, "step": _rows_of(self._step),
            "score": None if self._merging.scaler is None else self._merging.scaler.state_dict(),
        }  # fmt: skip

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state, after the host has loaded its parameters."""
        self.t, self.passes = int(state["t"]), int(state["passes"])
        self._steps.by_hand = state.get("by_hand", 0)
        self.conductor.load_state_dict(state["strategies"])
        self._host.restart_parents()
        leaves = self._host.leaves()
        self._n = len(leaves["means"])
        self._merging.fading.resume(leaves.get("detail"), int(state.get("passes_with_hr", 0)))
        view = next((view for view in self.conductor.views if view.name == state.get("view")), None)
        if view is not None:  # its `after_step` is still to come
            rows = {name: x.to(leaves["means"].device) for name, x in state.get("step", {}).items()}
            evidence = Evidence(rows["reliability"], rows["demand"]) if "demand" in rows else None
            self._step = Step(self.t, view, rows.get("visible"), evidence)
        if self._merging.scaler is not None and state.get("score") is not None:
            self._merging.scaler.load_state_dict(state["score"])

    def summary(self) -> str:
        """How often each kind of work was done, e.g. for the end of a log."""
        return ", ".join(f"{n:,} {what}" for what, n in self.counts.items()) or "nothing was done"

    @property
    def log(self) -> dict[str, float]:
        """Scalars of the last iteration that was merged. On a device, reading them waits for the device."""
        return deferred.resolve([computed(self._logged)])[0]

    def remove(self) -> None:
        """Restore the host: its renderings pass through, and the gradients of a pending one are not merged."""
        self.removed, self._merging.pending = True, None
        self.hook([])
        self._steps.follow_by({}, [])
        if self.conductor.trains(self._run):  # else its strategies train another loop by now
            self.conductor.on_fit_end()
        for replays in filter(None, (self._hr.replays, self._merging.replayed.replays)):
            replays.release()
        self._finalizer()
        self.undo.close()

    def _before_optimizer(self) -> None:
        """Raise an error if an optimizer steps before the gradients of the rendering are merged."""
        pending = self._merging.pending
        if current_pass() >= 0 and pending is not None and pending.output is not None:
            raise HostError(
                "the host steps inside of its backward pass, where the gradients of the views are not merged yet. Step after "
                "loss.backward() has returned, not in a hook of a gradient."
            )

    def _step_begins(self, has_merged: bool) -> None:
        """Raise an error if no strategy takes part in the host's first step, or a gradient scaler's scale is unknown; warn of a
        later step without a strategy.
        """
        if has_merged:
            adds = self._host.loss_scale is None and (self.conductor.uses_hr or self.conductor.regularizers)
            if adds and (scaler := stepping_scaler()) and (scale := scaler.get_scale()) != 1:
                raise HostError(
                    f"the loop steps by a gradient scaler, which multiplies its loss by {scale:g}, but not what is added. Pass "
                    "loss_scale=scaler.get_scale; train a 3DGS-style loop without it."
                )
            self._warn_of_frozen()
            self._merging.fading.before_step(max(self.passes, self._host.accumulation))
            return
        names = [*trained(self._host.leaves())]
        cause, remedy = why_nothing_was_merged(self._merging.pending, names)
        if not self.counts["merges"]:
            raise HostError(
                f"the host makes its first optimizer step, but {cause}, so that no strategy would take part. {remedy}"
            )
        self.counts["steps of the host alone"] += 1
        self._warn_once(
            "the host makes a step in which no strategy takes part: %s, and %s changed without CLEAR or not at all. %s",
            cause, ", ".join(names) or "nothing", remedy,
        )  # fmt: skip

    def _warn_of_frozen(self) -> None:
        """In the first step: LapisGS freezes Gaussians by their gradients, which f_det and extra views do not obey."""
        leaves, rows, self._learning = self._host.leaves(), self._learning, None
        grad, changes = leaves["means"].grad, self.conductor.showing or ("detail" in leaves and self.conductor.uses_hr)
        if rows is None or grad is None or grad.is_sparse or len(grad) != len(rows) or not changes:
            return
        if n := int((rows & ~grad.any(-1)).sum()):
            _log.warning(
                "the loop sets the gradients of %s Gaussians to 0 before it steps. If it freezes them, f_det still changes their "
                "colours, extra views move them, and fading opacities fade. Leave out what is not meant, e.g. pseudo_views.",
                f"{n:,}",
            )  # fmt: skip

    def _after_optimizer(self) -> None:
        """Finish the step once all optimizers have stepped: strategies may change parameters in place, and the loop may compute
        with them before it renders again. The iteration in which densification ends is finished at the next rendering, since
        the host may still densify in it, and an anchor is taken after that.
        """
        may_densify = self.conductor.may_densify
        if self._steps.is_complete and may_densify(self.t) == may_densify(max(1, self.t - 1)):
            self._finish_step()

    def _finish_step(self, rendered: View | None = None) -> None:
        """Call `on_resize` and `after_step`, after the host has stepped and perhaps densified.

        A step has all passes since the last one whose gradients the loop has kept. An iteration ends with its step, or after
        `accumulation` passes: a gradient scaler skips steps, and FastGS sums the views of many iterations. It does not end
        before another pass over the same view if the loop has dropped the gradients of the last, as in a step of SAM.

        Args:
            rendered: the view that the host renders next; None: it has stepped.
        """
        params = self._host.leaves()
        self._follow_structure(len(params["means"]))
        if not self.passes:
            return
        last, has_stepped = self._merging.pending, self._steps.has_begun  # None: of a loop that resumes
        gradients = (p.grad for name, p in params.items() if name != "detail")  # which the host may not zero
        are_dropped = has_stepped or not any(g is not None and bool(g.any()) for g in gradients)
        last_view = None if self._step is None else self._step.view.name
        again = are_dropped and rendered is not None and rendered.name == last_view and self._steps.are_known
        has_passed = (last is None or bool(last.merged)) and self.passes % self._host.accumulation == 0
        if has_stepped or (has_passed and not again):
            if self._step is not None:
                # Changed in place without a change of version, since the loop may have computed with them; frozen ones stay.
                changed = {name: p.data if p.requires_grad else p.detach().clone() for name, p in params.items()}
                self.conductor.after_step(changed, self._step)
            self.t += 1
        if are_dropped:
            self.passes = self._merging.fading.passes = 0

    def _follow_structure(self, n: int) -> None:
        """Tell the strategies about a change of structure, if there was one; the host has n Gaussians now."""
        parents = self._host.poll_parents()
        if parents is not None or n != self._n:
            self._step = resized(self.conductor, self._step, self._n, n, parents, self._host.remedy)
            self._n = n
            self.counts["structure changes"] += 1

    def _merged(self, pending: Pending, conflict: Mapping[str, Number] | None, before: Mapping[str, Tensor]) -> None:
        """Called when gradients of a rendering were merged: the first of them with their conflict ratios, or more of them.

        Args:
            before: `.grad` before the pass, by name.
        """
        self._steps.on_merge(first=conflict is not None)
        if conflict is None:
            return
        if self._steps.by_hand is not None and (grad := self._host.leaves()["means"].grad) is not None:
            self._learning = grad.any(-1)
        self._dropped = self.passes > 0 and not any(bool(g.any()) for name, g in before.items() if name != "detail")
        if self._dropped:
            self.passes = self._merging.fading.passes = 0
        self.passes += 1
        if self.passes > self._host.accumulation:
            self._warn_once(
                "%d backward passes over training views add to the same gradients, without an optimizer step between them, but "
                "accumulation=%d. If the loop divides each loss by the number of views in a step, HR weighs too much: pass that "
                "number as accumulation. If the loop sums the losses of several iterations, all is well.",
                self.passes, self._host.accumulation,
            )  # fmt: skip
        λ = self.conductor.objective.lambda_hr(self.t)
        losses, shares = {} if pending.hr is None else pending.hr.losses, conflict_columns(conflict)
        row: dict[str, Logged] = {"t": float(self.t), "lambda_hr": λ, **losses, **shares}
        self._logged = row | self.conductor.logs.scalars(row)
        if self.counts["merges"] % _LOGGED_EVERY == 0:
            now = self.log
            losses_now = ", ".join(f"L_{name} {now[name]:.4f}" for name in losses) or "no HR"
            _log.info("t=%d: %s, lambda_HR %.3f, %s Gaussians.", self.t, losses_now, λ, f"{self._n:,}")


def _checked(render_at: RenderAt, params: Mapping[str, Tensor]) -> RenderAt:
    """The function of an adapter, which raises an error if what it returns has another type, or is of other tensors."""

    def render(target: Target, gate: Tensor | None, view: View) -> HostOutput | Drawable:
        output = render_at(target, gate, view)
        if isinstance(output, HostOutput):
            require_named(output.shot, params)
        elif target == "lr" or not isinstance(output, Drawable):
            raise TypeError(f"render_at must return a HostOutput for {target!r}, got {type(output).__name__}.")
        return output

    return render


def _rows_of(step: Step | None) -> dict[str, Tensor]:
    """The tensors per Gaussian of a step, for a checkpoint."""
    if step is None:
        return {}
    e, visible = step.evidence, {} if step.visible is None else {"visible": step.visible}
    return visible | ({} if e is None else {"reliability": e.reliability, "demand": e.demand})


def _require_supported(conductor: Conductor) -> None:
    """Raise a SettingError for settings that no host supports."""
    if not conductor.wants_lr:
        raise SettingError(
            "objective: a host renders LR itself, so lambda_lr must be > 0 and lr_from must be lr, got "
            f"lambda_lr={conductor.objective.lambda_lr}, lr_from={conductor.objective.lr_from!r}."
        )
    if apart := [type(s).__name__ for s in conductor.strategies if not s.shares_gate]:
        raise SettingError(f"{apart[0]}: other trainers render both scales with one mask. Leave out shared=false.")
    _require_one_process()


def _require_one_process() -> None:
    """Raise a SettingError where each process would train f_det and the strategies' state by itself."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized() and (n := distributed.get_world_size()) > 1:
        raise SettingError(
            f"CLEAR trains in one process, got {n}. Start the training on one device: without torchrun, with "
            "CUDA_VISIBLE_DEVICES=0, in nerfstudio with machine.num_devices=1. Or average the gradients of joint_loss."
        )
