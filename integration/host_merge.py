"""The host's backward passes: at the end of each, the merged gradients replace those that it has added."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Final
from weakref import ReferenceType, WeakMethod, ref

import torch
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.finite import is_finite, require_finite
from clear_strategies.core.gradients import Grads, to_ndc
from clear_strategies.core.step import Step
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import HrSide
from clear_strategies.merging.replay import merging_strategies
from integration.announcement import Once
from integration.autograd_shot import AutogradShot, trained
from integration.densification import ScoreScaler, score_for_host
from integration.detail import Fading
from integration.host import Host
from integration.pending import BackwardPass, Pending, why_nothing_was_merged, widened
from integration.replayed_merge import ReplayedMerge
from rasterizers.differentiable import TakeColours
from rasterizers.torch_internals import current_pass, when_pass_ends

_log = logging.getLogger(__name__)
_IN_VAIN: Final = 10  # renderings that are not merged, one after the other, before a warning
_PATIENCE: Final = 10  # merges in which the loop's gradients outweigh those of HR, before a warning
_OUTWEIGHS: Final = 30.0  # their ratio; in gsplat's loop on the demo it lies between 0.5 and 1.4


class HostMerge:
    """Merges the gradients of the last rendering, after one backward pass of the host, or after several to different parameters.

    Args:
        device: of the Gaussians. counts: `Attachment.counts`, to which this class adds.
        merged: called after each merge, with the conflict ratios by group before correction if it is the first of its rendering,
            and what `.grad` held before the pass, by name.

    Attributes:
        pending: the last rendering; None: there is none, or none is to be merged any more.
        scaler: of the densification score; None: the host reads none.
        fading: of f_det.
        replayed: merges by recordings on CUDA.
    """

    def __init__(
        self, conductor: Conductor, host: Host, device: torch.device, counts: Counter[str],
        merged: Callable[[Pending, Mapping[str, Number] | None, Mapping[str, Tensor]], None],
    ) -> None:  # fmt: skip
        self._conductor, self._host, self._counts, self._merged = conductor, host, counts, merged
        self._warn_once = Once(_log.warning)
        self.pending: Pending | None = None
        self.scaler = None if host.threshold is None else ScoreScaler(host.threshold)
        self.fading = Fading(conductor.detail)
        self.replayed = ReplayedMerge(conductor, device)
        self._pass: ReferenceType[BackwardPass] | None = None  # the last to reach a rendering; torch keeps it alive
        self._in_vain = 0  # renderings, one after the other, that were not merged
        self._outweighed: int | None = 0  # of the first merges with HR; None: in one of them HR had a part

    def await_passes(self, pending: Pending, *, to_screen: bool) -> None:
        """Merge this rendering in place of the last one; warn if no backward pass has merged the last ones: nobody may tell
        otherwise that a loop steps other tensors.
        """
        if self.pending is not None:
            self._in_vain = 0 if self.pending.merged else self._in_vain + 1
            if self._in_vain == _IN_VAIN:
                cause, remedy = why_nothing_was_merged(self.pending, [*trained(self._host.leaves())])
                _log.warning(
                    "CLEAR has no part in the last %d renderings of training views: %s. %s Evaluate under torch.no_grad().",
                    _IN_VAIN, cause, remedy,
                )  # fmt: skip
        self.pending = pending
        pending.listen(WeakMethod(self._reached), to_screen=to_screen)

    def _reached(self, nth: int) -> TakeColours | None:
        """Called when a backward pass of the host has reached the nth rendering, but no parameter yet."""
        if self.pending is None:
            return None
        now = None if self._pass is None else self._pass()
        if now is None or now.task != current_pass():
            now = BackwardPass(current_pass(), self._host.leaves(), [leaf for leaf, _ in self.pending.others])
            when_pass_ends(partial(self._on_backward_end, now))
            self._pass = ref(now)
        now.renderings.add(nth)
        return now.take if self.pending.may_take_factors(now.params) else None

    @torch.no_grad()
    def _on_backward_end(self, done: BackwardPass) -> None:
        """At the end of a backward pass of the host, replace the gradients that it added by the merged ones.

        A pass that leaves every `.grad` as it was (`torch.autograd.grad`) is ignored.
        """
        pending, expected, accumulated = self.pending, trained(done.params), done.accumulated()
        if pending is not None and (accumulated or not expected):
            pending.require_alone(done)
            using = [type(s).__name__ for s in map(self._conductor.owner, ("reconcile", "score")) if s is not None]
            pending.require_first(accumulated, " and ".join(using))
            names = [name for name in accumulated if name not in pending.merged]
            if names or not (expected or pending.merged or pending.has_no_part()):
                self._merge(pending, done, names)
        if pending is not None and pending.others and done.renderings == {pending.nth}:
            self._add_to_others(pending, done)
        for hook in done.hooks:
            hook()
        if pending is not None and pending.merged.issuperset(expected):
            pending.output = pending.hr = None

    def _add_to_others(self, pending: Pending, done: BackwardPass) -> None:
        """Add HR's gradients of other leaves to those that the pass has given."""
        weight = self._host.scale() * self._conductor.objective.lambda_hr(pending.t)
        for leaf, g in pending.others:
            if leaf.grad is not None and done.has_given(leaf):
                leaf.grad.add_(g, alpha=weight)
        pending.others = [(leaf, g) for leaf, g in pending.others if not done.has_given(leaf)]

    def _merge(self, pending: Pending, done: BackwardPass, names: Sequence[str]) -> None:
        """Merge the gradients of these parameters; with the first of the rendering, merge that of f_det and write the score.

        Raises:
            HostError: a gradient is sparse.
            DivergedError: see `merge_gradients`.
        """
        params, hr, first = {name: done.params[name] for name in names}, pending.hr, not pending.merged
        scale = self._host.scale()
        for name, p in params.items():
            if p.grad is not None and p.grad.is_sparse:
                raise HostError(
                    f"{name}.grad is sparse, but the gradients of all Gaussians are merged. In gsplat: "
                    "rasterization(sparse_grad=False)."
                )
            if p.grad is not None and p.grad.requires_grad:
                p.grad = p.grad.detach()
                self._warn_once(
                    "backward(create_graph=True) leaves no graph behind .grad, which holds the merged gradient: a gradient "
                    "penalty that is computed from .grad has no effect. Compute it by torch.autograd.grad(…, create_graph=True)."
                )
        detail = done.params.get("detail") if first else None
        if detail is not None and not detail.requires_grad:
            detail = None
        if detail is not None and detail.grad is not None:  # the host's own gradient of it stays
            done.before["detail"] = detail.grad
        t, λ = pending.t, self._conductor.objective.lambda_hr(pending.t)
        g_hr = pending.routed_of(names, done.params) if λ > 0 else Grads()
        self._warn_if_outweighed(done, g_hr, scale)
        of_all = [*names] if detail is None else [*names, "detail"]
        conflict = self.merge_gradients(done, of_all, g_hr, None if hr is None else hr.step, t, scale)
        pending.merged.update(names or ("detail",))
        self._counts["merges"] += 1
        if first and hr is not None and pending.output is not None and done.task in pending.screen:
            self._write_score(pending.output.shot, pending.screen[done.task], hr, t, scale)
        self._merged(pending, conflict if first else None, done.before)
        if detail is not None:
            self._finish_detail(detail, params, t, by_hf=hr is not None and hr.detail is not None)

    def merge_gradients(
        self, done: BackwardPass, names: Iterable[str], g_hr: Grads, step: Step | None, t: int, scale: float
    ) -> Mapping[str, Number]:  # fmt: skip
        """Merge what the pass has added to `.grad` of these parameters, in place.

        Args:
            g_hr: of the raw parameters after routing, and the gradient of f_det; empty without HR.  Eq. 12, 13
            step: the iteration, with the evidence; None without HR.
            scale: of the gradients of the pass: of a gradient scaler, or 1 / the number of accumulated passes.

        Raises:
            DivergedError: a merged gradient in the CPU's memory is not finite, and no gradient scaler would skip the step.
        """
        g_lr, out = done.added(names, scale)
        if not out:  # all Gaussians are frozen
            return {}
        params = {name: p.detach() for name, p in done.params.items()}  # frozen ones, too, which strategies read
        high = Grads({name: widened(g) for name, g in g_hr.items()}, colour=g_hr.colour)
        merged = self.replayed(params, g_lr, high, step, t, out)
        if self._host.loss_scale is None and not isinstance(merged.finite, Tensor) and not merged.finite:
            by_host = all(map(is_finite, [*high.values(), *(high.colour or ())]))
            mine = "".join(f", and at the answers of {type(s).__name__}" for s in merging_strategies(self._conductor))
            hint = f" (that of HR is finite: look at the loop's own loss{mine})" if by_host else ""
            remedy = "If the loop skips such steps, attach with loss_scale=lambda: 1.0."
            require_finite(f"t={t}: the merged gradient{hint}", merged.grads, remedy=remedy)
        done.replace(out, scale)
        return merged.conflict

    def _warn_if_outweighed(self, done: BackwardPass, g_hr: Mapping[str, Tensor], scale: float) -> None:
        """Warn if the loss of the loop has another scale than that of HR, which is a mean over pixels in [0, 1]."""
        if self._outweighed is None:
            return
        ratios = list[float]()
        for name, h in g_hr.items():
            g = done.params[name].grad
            if g is not None and name != "detail":
                own = g - done.before[name] if name in done.before else g
                ratios.append(float(own.norm() / (scale * h.norm())))
        if not ratios:
            return
        self._outweighed = self._outweighed + 1 if min(ratios) > _OUTWEIGHS else None
        if self._outweighed == _PATIENCE:
            self._outweighed = None
            _log.warning(
                "the gradients of the loop's loss are %.0f times those of HR, which then has no effect. Let the loss be a mean "
                "over the pixels of images in [0, 1], and with a gradient scaler pass loss_scale=scaler.get_scale.", min(ratios),
            )  # fmt: skip

    def _write_score(self, shot: AutogradShot, screen: Tensor, hr: HrSide, t: int, scale: float) -> None:
        """Write the score to the tensor that the host's densifier reads, if it reads one and a strategy has a score."""
        slot = shot.gradient_slot
        if not (slot.tensor.is_leaf or slot.tensor.retains_grad) or slot.tensor.grad is None:
            return
        screen_lr = to_ndc(slot.per_gaussian(screen / scale, len(shot.visible)), slot.size)
        score, ordinary = self._conductor.scores(screen_lr, hr, self._conductor.objective.weights(t))
        if score is ordinary:  # no strategy has a score: the host's own statistic stays
            return
        statistic = torch.linalg.vector_norm(screen_lr, dim=-1)  # the host's own
        written = score_for_host(slot, score, statistic, shot.visible, self.scaler, scale)
        if written is not None:
            slot.write(scale * written)
            self._counts["scores written"] += 1

    def _finish_detail(self, detail: Tensor, others: Mapping[str, Tensor], t: int, *, by_hf: bool) -> None:
        """Prepare f_det for the step of the host's optimizer, after its merge."""
        if self._host.loss_scale is not None and detail.grad is not None:
            # A gradient scaler skips steps by optimizer: f_det's is skipped with the others, as 0 times inf or NaN is NaN.
            for p in others.values():
                if p.grad is not None:
                    detail.grad += 0 * p.grad.sum(dtype=torch.float32)
        if by_hf:
            self.fading.add_pass(detail, is_learned=self._conductor.objective.lambda_hr(t) > 0)
