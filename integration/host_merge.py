"""The merge at the end of a host's backward pass: the merged gradients replace those that the pass has added."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import torch
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import to_ndc
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.in_place import merge_in_place
from clear_strategies.merging.iteration import HrSide
from integration.autograd_shot import AutogradShot
from integration.densification import ScoreScaler, score_for_host
from integration.detail import Fading
from integration.host import Host
from integration.pending import BackwardPass, Pending
from integration.replayed_merge import ReplayedMerge

_log = logging.getLogger(__name__)
_PATIENCE: Final = 10  # merges in which the loop's gradients outweigh those of HR, before a warning
_OUTWEIGHS: Final = 30.0  # their ratio; in gsplat's loop on the demo it lies between 0.5 and 1.4


class HostMerge:
    """Merges the gradients of a rendering, after one backward pass, or after several with different parameters.

    Args:
        device: of the Gaussians. counts: `Attachment.counts`, to which this class adds.

    Attributes:
        scaler: of the densification score; None: the score is not scaled.
        fading: of f_det.
    """

    def __init__(self, conductor: Conductor, host: Host, device: torch.device, counts: Counter[str]) -> None:
        self._conductor, self._host, self._counts = conductor, host, counts
        self.scaler = None if host.threshold is None else ScoreScaler(host.threshold)
        self.fading = Fading(conductor.detail, host.accumulation)
        self._replayed = ReplayedMerge(conductor, device)
        self._outweighed: int | None = 0  # of the first merges with HR; None: in one of them HR had a part

    def merge(self, pending: Pending, done: BackwardPass, names: Sequence[str], t: int) -> Mapping[str, Number]:
        """Merge the gradients of these parameters; with the first of the rendering, merge that of f_det and write the score.

        Returns:
            The conflict ratios by group, before correction.

        Raises:
            HostError: a gradient is sparse.
            DivergedError: a merged gradient is not finite, and no gradient scaler would skip the step.
        """
        params, hr, first = {name: done.params[name] for name in names}, pending.hr, not pending.merged
        scale, skips_steps = self._host.scale(), self._host.loss_scale is not None
        for name, p in params.items():
            if p.grad is not None and p.grad.is_sparse:
                raise HostError(
                    f"{name}.grad is sparse, but the gradients of all Gaussians are merged. In gsplat: "
                    "rasterization(sparse_grad=False)."
                )
            if p.grad is not None and p.grad.requires_grad:
                p.grad = p.grad.detach()  # create_graph=True: the merged gradient has no graph
        detail = done.params.get("detail") if first else None
        if detail is not None and detail.requires_grad:
            params["detail"] = detail
            if detail.grad is not None:  # the host's own gradient of it stays
                done.before["detail"] = detail.grad
        λ = self._conductor.objective.lambda_hr(t)
        g_hr = pending.routed_of(names, done.params) if λ > 0 else None
        if g_hr is not None:
            self._warn_if_outweighed(done, g_hr, scale)
        conflict = merge_in_place(
            self._conductor, params, g_hr, None if hr is None else hr.step, t,
            before=done.before, lr_colour=done.colour, scale=scale, must_be_finite=not skips_steps, merge=self._replayed,
        )  # fmt: skip
        if "detail" in params:
            self._finish_detail(params.pop("detail"), params, t, by_hf=hr is not None and hr.detail is not None)
        pending.merged.update(names or ("detail",))
        self._counts["merges"] += 1
        if first and hr is not None and pending.output is not None and done.task in pending.screen:
            self._write_score(pending.output.shot, pending.screen[done.task], hr, t, scale)
        return conflict

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
