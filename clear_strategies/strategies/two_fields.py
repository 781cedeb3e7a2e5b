"""Two fields: a second field with a seed of its own, and each learns from what the other shows.

Where no photo looks, a field invents, and what it invents depends on its seed. Two fields of two seeds agree on what the photos
tell and differ in the rest; a step towards the other's picture by a camera that no photo has damps what only one of them shows
(CoR-GS, Zhang et al. 2024). It takes twice the time.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.points import spread
from clear_strategies.core.seeds import hashed_generator_at, one_of
from clear_strategies.core.step import Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.geometry.pseudo_views import beside
from clear_strategies.schedules import milestone
from clear_strategies.strategies.base import Drawn, Strategy
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_APART: Final = 1_000  # of the seeds: more than a table of runs has
_INVISIBLE: Final = -6.9  # the logit of an opacity of 0.001, which density control removes and sampling moves


@dataclass(frozen=True)
class TwoFields(Strategy):
    """Co-regularisation of two fields. For this package's trainer: another one holds a single model.

    Args:
        every: iterations from one shared picture to the next, at least 1.
        start: no pictures are shared before it: neither field shows anything yet.
        reach: as that of `PseudoViews`, as a multiple of a camera's distance from the middle of the Gaussians.
        size: of the pictures, as a multiple of LR's, at most HR's.
        weight: of their LR loss, > 0, as a multiple of a photo's, which is λ_LR.
        alone: Gaussians that are farther from all of the other field than this share of the scene's size (the 90th percentile
            of the distance from its median) become invisible, so that density control removes them; 0: none does.
        compare_every, compare_until: iterations between two such comparisons, and the last that may have one.

    Raises:
        SettingError: a setting is outside its range.
    """

    every: int = 2
    start: int = milestone(2_000)
    reach: float = 1.2
    size: int = 2
    weight: float = 1.0
    alone: float = 0.0
    compare_every: int = milestone(500, least=1)
    compare_until: int = milestone(5_000)

    def __post_init__(self) -> None:
        for name in ("every", "size", "compare_every"):
            require_whole(name, getattr(self, name), least=1)
        for name in ("reach", "weight"):
            require_number(name, getattr(self, name), above=0)
        require_number("alone", self.alone)

    def on_views(self, views: Sequence[View]) -> None:
        self.cache["cameras"] = [view.lr.camera.scaled(min(self.size, view.factor)) for view in views]

    def second_seed(self, seed: int) -> int:
        return seed + _APART

    def drawn_views(self, t: int, drawn: Drawn) -> Sequence[ExtraView]:
        """What the other field shows by a camera that is a function of (seed, t) and of where its Gaussians are."""
        if self.alone > 0 and t % self.compare_every == 0 and self.start <= t <= self.compare_until:
            self.cache["others"] = drawn.means
        cameras: Sequence[Camera] = self.cache.get("cameras", ())
        if t < self.start or t % self.every or not cameras:
            return ()
        generator = hashed_generator_at(self.seed, t)
        camera = beside(one_of(cameras, generator), drawn.means, self.reach, generator)
        image = drawn.draw(camera)
        return (ExtraView(Photo(camera, image), torch.full_like(image[..., 0], self.weight)),)

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        """Hide the Gaussians that the other field contradicts; `others` is there at iterations that compare."""
        others: Tensor | None = self.cache.pop("others", None)
        if others is not None:
            far = distances(params["means"], others) > self.alone * spread(others)
            params["opacities"].masked_fill_(far, _INVISIBLE)
            _log.debug("t=%d: %d Gaussians are alone in their field.", step.t, int(far.sum()))

    def on_fit_end(self) -> None:
        self.cache["cameras"] = ()

    def summary(self) -> str | None:
        if not self.cache.get("cameras"):
            return None
        return f"a second field of another seed, a shared picture every {self.every} iterations from t={self.start}"

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        return "it is the LR loss that shared pictures are trained by, and lambda_lr is 0" if lambda_lr == 0 else None


def distances(points: Float[Tensor, "N 3"], others: Float[Tensor, "M 3"]) -> Float[Tensor, " N"]:
    """From each point to the nearest of the others."""
    from scipy.spatial import cKDTree

    nearest = cKDTree(others.cpu().numpy()).query(points.cpu().numpy())[0]
    return torch.from_numpy(nearest).to(points)
