"""SplatSuRe's weighting, Gaussian-wise: SR detail goes where no other view shows more, authentic pixels do the rest.

A Gaussian that one view sees from near and another from far is sampled well by the near view's LR photo; the far view's
SR reference can only guess what that photo shows. So its HR gradient is withheld in every view but the one that samples
it best.

SplatSuRe's: the ratio, the sigmoid, the exemptions, and the constants. Ours: it weighs pixels of each SR image by a map,
1 - render(score) + render(best here), that a first field trained on LR has drawn once; we weigh each Gaussian's gradient
while the one field trains. Its ratio is of screen radii; ours of f / z, their ratio for round Gaussians, which no scale
that is still being learnt can fool. Densification goes by the unweighted gradient.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Grads, Shot
from clear_strategies.strategies.base import Strategy
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_NOW: Final = "what this iteration shows"


@dataclass(frozen=True)
class SplatSuRe(Strategy):
    """Withhold HR gradients where another view samples the Gaussian better.

    `state` holds, by view, every Gaussian's sampling rate f / z (HR pixels per world unit) when the view last showed it,
    0 where it never did. A weight therefore needs all views to have been visited; until then it is 1.

    Args:
        ratio: τ, the ratio of the finest to the coarsest sampling rate at which half of the HR gradient is withheld.
        softness: of the sigmoid around τ, > 0.
        min_views: Gaussians that fewer views have shown keep all of their HR gradient.

    Raises:
        ValueError: a setting is outside its range.
    """

    ratio: float = 1.1
    softness: float = 0.05
    min_views: int = 3

    def __post_init__(self) -> None:
        if not self.ratio >= 1:
            raise ValueError(f"ratio must be >= 1 (finest over coarsest), got {self.ratio}.")
        if not self.softness > 0:
            raise ValueError(f"softness must be > 0, got {self.softness}.")
        if self.min_views < 1:
            raise ValueError(f"min_views must be at least 1, got {self.min_views}.")

    def on_fit_start(self, n_views: int, seed: int) -> None:
        super().on_fit_start(n_views, seed)
        if n_views < self.min_views:
            _log.warning(
                "SplatSuRe has no effect: %d training views are fewer than min_views=%d, so that every weight is 1.",
                n_views, self.min_views,
            )  # fmt: skip

    def observe(self, view: Any, hr: Shot) -> Evidence | None:
        """Remembers which view this is, and whom it shows; gives no evidence of reliability."""
        self.cache[_NOW] = view.name, view.hr.camera, hr.visible
        return None

    def correct(self, lr: Grads, hr: Grads, evidence: Evidence | None) -> Grads:
        """W g_HR, attribute by attribute."""
        name, _, visible = self.cache[_NOW]
        rows = next(iter(hr.values()))
        w = self.weight(name).to(rows) if self.state else rows.new_ones(len(rows))
        self.readings["mean_hr_weight"] = deferred.mean(w, visible)
        return hr * w

    def weight(self, name: str) -> Float[Tensor, " N"]:
        """1 - score in the view called `name`, and 1 where that view samples best.

        The score is sigmoid((finest / coarsest - τ) / softness) over the views that have shown a Gaussian, 0 where they
        are too few.
        """
        rates = list(self.state.values())
        finest, coarsest, views = rates[0], rates[0].new_full(rates[0].shape, torch.inf), torch.zeros_like(rates[0])
        for rate in rates:
            finest = torch.maximum(finest, rate)
            coarsest = torch.where(rate > 0, torch.minimum(coarsest, rate), coarsest)
            views = views + (rate > 0)
        score = torch.sigmoid((finest / coarsest - self.ratio) / self.softness)
        exempt = views < self.min_views
        if name in self.state:
            exempt |= self.state[name] == finest
        return torch.where(exempt, 1.0, 1 - score)

    def after_step(self, params: Mapping[str, Tensor], t: int) -> None:
        """This view's sampling rates of the Gaussians that it shows."""
        if _NOW not in self.cache:
            return
        name, camera, visible = self.cache.pop(_NOW)
        pose = self._pose(name, camera).to(params["means"])
        z = params["means"] @ pose[2, :3] + pose[2, 3]
        before = self.state.get(name, torch.zeros_like(z))
        self.state[name] = torch.where(visible & (z > 0), camera.fx / z, before)

    def _pose(self, name: str, camera: Camera) -> Float[Tensor, "4 4"]:
        """World to camera, where the field lies; sent there once, and again when the view has another camera."""
        sent: tuple[Camera, Tensor] | None = self.cache.get(("pose", name))
        if sent is None or sent[0] is not camera:
            sent = self.cache["pose", name] = camera, camera.world_to_camera.to(self.device)
        return sent[1]
