"""Where a backward pass of the host has ended: the gradients that it has brought become the merged ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.in_place import merge_in_place
from integration.densification import ScoreScaler, write_score
from integration.detail import Fading
from integration.pending import BackwardPass, Pending
from integration.replayed_merge import ReplayedMerge


class HostMerge:
    """The merge of a rendering, which one backward pass ends or several do, each with other parameters.

    Args:
        device: of the Gaussians.
        threshold, loss_scale, accumulation: see `Attachment`.

    Attributes:
        scaler: of the densification score; None: the score is not scaled.
        fading: of f_det.
    """

    def __init__(
        self, conductor: Conductor, device: torch.device, *, threshold: float | None, loss_scale: Callable[[], float] | None,
        accumulation: int,
    ) -> None:  # fmt: skip
        self._conductor, self._loss_scale, self._accumulation = conductor, loss_scale, accumulation
        self.scaler = None if threshold is None else ScoreScaler(threshold)
        self.fading = Fading(conductor.detail, accumulation)
        self._merge_in_place: Callable[..., Mapping[str, Number]] = partial(
            merge_in_place, conductor, merge=ReplayedMerge(conductor, device)
        )

    def scale(self) -> float:
        """The factor of the gradients of one pass. A gradient scaler's waits for the device."""
        return (1.0 if self._loss_scale is None else self._loss_scale()) / self._accumulation

    def merge(
        self, pending: Pending, done: BackwardPass, names: Sequence[str], t: int, scale: float
    ) -> Mapping[str, Number]:
        """Merge the gradients of these parameters, and of f_det with the first of the rendering.

        Args:
            scale: of this pass.

        Returns:
            The conflict ratios by group, before correction.

        Raises:
            HostError: a gradient is sparse.
            DivergedError: a merged gradient is not finite, and no gradient scaler would skip the step.
        """
        params, hr = {name: done.params[name] for name in names}, pending.hr
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
        detail = None if pending.merged else done.params.get("detail")
        if detail is not None and detail.requires_grad:
            params["detail"] = detail
            if detail.grad is not None:  # what the host has given it stays
                done.before["detail"] = detail.grad
        conflict = self._merge_in_place(
            params, pending.routed_of(names, done.params), None if hr is None else hr.step, t, before=done.before,
            lr_colour=done.colour, scale=scale, must_be_finite=self._loss_scale is None,
        )  # fmt: skip
        if "detail" in params:
            self._finish_detail(params.pop("detail"), params, t, by_hf=hr is not None and hr.detail is not None)
        pending.merged.update(names or ("detail",))
        return conflict

    def write_score(self, pending: Pending, done: BackwardPass, t: int, scale: float) -> bool:
        """Write the densification score of the rendering; False: the host's densifier does not read it, or there is none."""
        screen, hr = pending.screen.get(done.task), pending.hr
        if screen is None or pending.output is None or hr is None:
            return False
        scores = partial(self._conductor.scores, hr=hr, weights=self._conductor.objective.weights(t))
        return write_score(pending.output.shot, screen / scale, scores, self.scaler, scale)

    def _finish_detail(self, detail: Tensor, others: Mapping[str, Tensor], t: int, *, by_hf: bool) -> None:
        """After the merge of f_det, which the host's optimizer steps as the others."""
        if self._loss_scale is not None and detail.grad is not None:
            # A gradient scaler asks each optimizer apart whether to step; 0 times a number that is not finite is not finite.
            for p in others.values():
                if p.grad is not None:
                    detail.grad += 0 * p.grad.sum(dtype=torch.float32)
        if by_hf:
            self.fading.add_pass(detail, is_learned=self._conductor.objective.lambda_hr(t) > 0)
