"""SplatSuRe's weighting, per Gaussian: SR detail is used if no other view samples the Gaussian better.

If one view sees a Gaussian from near and another from far, the LR photo of the near view shows what the SR image of
the far view can only guess. The HR gradient of the Gaussian is therefore withheld in all views but the one that samples it best.

The ratio, the sigmoid, the exemptions and the constants are SplatSuRe's. Two things differ. SplatSuRe weighs the pixels of
each SR image by a map, rendered once from a field that was first trained on LR; this strategy weighs each Gaussian's gradient
while the field trains. SplatSuRe's ratio is of screen radii; this one is of f / z, which is the same for round Gaussians and does
not depend on scales that still change. Densification uses the unweighted gradient.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.step import Step
from clear_strategies.errors import counted
from clear_strategies.strategies.base import Strategy
from rasterizers.geometry import depths
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SplatSuRe(Strategy):
    """Withholds HR gradients of Gaussians that another view samples better.

    `state` holds, by view, the sampling rate f / z of each Gaussian (HR pixels per world unit) when it was last visible in
    that view, and 0 before. So a Gaussian keeps its whole HR gradient until `min_views` views have shown it.

    Args:
        ratio: τ, the ratio of the finest to the coarsest sampling rate at which half of the HR gradient is withheld.
        softness: width of the sigmoid around τ, > 0.
        min_views: Gaussians that are visible in fewer views keep all of their HR gradient.

    Raises:
        SettingError: a setting is outside its range.
    """

    ratio: float = 1.1
    softness: float = 0.05
    min_views: int = 3

    def __post_init__(self) -> None:
        require_number("ratio", self.ratio, least=1)
        require_number("softness", self.softness, above=0)
        require_whole("min_views", self.min_views, least=1)

    def on_fit_start(self, n_views: int, seed: int) -> None:
        super().on_fit_start(n_views, seed)
        if n_views < self.min_views:
            _log.warning(
                "SplatSuRe has no effect: %s, fewer than min_views=%d, so that every weight is 1.",
                counted(n_views, "training view"), self.min_views,
            )  # fmt: skip

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        return "lambda_HR is 0 throughout" if lambda_hr == 0 else None

    def reconcile(self, products: Products, step: Step | None) -> Weights:
        """W g_HR."""
        if step is None or not self.state:
            return Weights()
        w = self.weight(step.view.name)
        if step.visible is not None:
            self.log("mean_hr_weight", deferred.mean(w, step.visible))
        return Weights(keep=w)

    def weight(self, name: str) -> Float[Tensor, " N"]:
        """1 - score in the view called `name`, and 1 where that view samples best.

        The score is sigmoid((finest / coarsest - τ) / softness) over the views in which a Gaussian has been visible; it is
        0 where these are fewer than `min_views`.
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

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        """Store the sampling rates of the Gaussians that the view of this step shows."""
        if step.visible is None:
            return
        name, camera = step.view.name, step.view.lr.camera  # skips halve the HR side for a part of the run
        pose = self._pose(name, camera).to(params["means"])
        z = depths(params["means"], pose)
        rates = self.state.setdefault(name, torch.zeros_like(z))
        rates.copy_(torch.where(step.visible & (z > 0), camera.fx / z, rates))

    def _pose(self, name: str, camera: Camera) -> Float[Tensor, "4 4"]:
        """World to camera on the device of the field, cached until the view has another camera."""
        sent: tuple[Camera, Tensor] | None = self.cache.get(("pose", name))
        if sent is None or sent[0] is not camera:
            sent = self.cache["pose", name] = camera, camera.world_to_camera.to(self.device)
        return sent[1]
