"""What an iteration takes the gradients of besides the host's own rendering: HR, and extra views."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.gradients import Grads
from clear_strategies.core.view import ExtraView, View
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import HrSide
from integration.autograd_shot import AutogradShot
from integration.own_drawing import Drawable, OwnDrawing, RenderAt
from integration.views import enlarged_mask

_log = logging.getLogger(__name__)


class HrDrawing:
    """HR and extra views, drawn by the host's function or by this package's rasterizer, as the adapter asks for.

    Args:
        device: of the Gaussians.
        masks, reads_score: see `Attachment`. counts: `Attachment.counts`, to which this adds.

    Attributes:
        is_scored: whether a strategy has a densification score, and the host's densifier reads it.
    """

    def __init__(
        self, conductor: Conductor, device: torch.device, masks: Mapping[str, Tensor], counts: Counter[str], *, reads_score: bool
    ) -> None:  # fmt: skip
        self._conductor, self._masks, self._counts = conductor, masks, counts
        self.is_scored = reads_score and conductor.owner("score") is not None
        self._own_drawing = OwnDrawing(conductor, device)

    def wanted(self, t: int) -> bool:
        """Whether HR takes part at t. Where the host's densifier reads its score, no iteration is skipped."""
        conductor = self._conductor
        scores = self.is_scored and conductor.may_densify(t)
        return conductor.wants_hr(t) and (scores or not conductor.skips.leaves_out_hr(t, conductor.work_log))

    def hr(
        self, view: View, t: int, gate: Float[Tensor, " N"] | None, render_at: RenderAt, params: Mapping[str, Tensor]
    ) -> tuple[HrSide, Grads | None]:
        """The gradients of HR, and the same of the raw parameters where HR takes part in the merge."""
        self._counts["HR renders"] += 1
        conductor, mask, drawn = self._conductor, self._masks.get(view.name), render_at("hr", gate, view)
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
        return hr, shot.routed(hr) if merges else None

    def extra_view(self, extra: ExtraView, view: View, t: int, render_at: RenderAt) -> Grads:
        """The gradient of an extra view, which is drawn without a gate and without f_det."""
        drawn = render_at(extra.photo.camera, None, view)
        if isinstance(drawn, Drawable):
            return self._own_drawing.extra_view(drawn, extra, t)
        (g,) = drawn.shot.vjp(self._conductor.extra_loss(drawn.shot.image, extra, t).cotangents)
        return g

    def _count_parts(self, n: int) -> None:
        self._counts["HR renders in parts"] += 1
        if self._counts["HR renders in parts"] == 1:
            _log.info(
                "The host calls its rasterizer %d times for one rendering, so each of the two HR gradients needs a backward "
                "pass of its own: with 46,000 Gaussians a step takes 1.4 times as long. Call it under torch.no_grad() for "
                "what is only looked at, and outside of the wrapped function for what only the LR loss needs.", n,
            )  # fmt: skip
