"""A stage of its own for the SR images, after S2Gaussian (Wan et al. 2025): first a field of the LR photos, then its refinement.

In the second stage each iteration also matches a picture at HR: by turns the SR image of a training view, and a render of the
first stage's field from a camera beside a training camera, enlarged by the network of the prior. Parts of both are invented, and
differently in each view, so pixels that the field contradicts count less (`ExtraView.robust`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.seeds import hashed_generator_at, one_of
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.geometry.cameras import beside
from clear_strategies.schedules import milestone
from clear_strategies.strategies.base import Strategy
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SRStage(Strategy):
    """HR pictures in a second stage. It has an effect only in this package's trainer, which calls `draw`.

    A run that is resumed in its second stage draws its pictures again, with a warning: its bits are not an uninterrupted run's.

    Args:
        start: the last iteration of the first stage.
        count: number of pictures from cameras beside the training cameras, at least 0.
        reach: largest distance of such a camera from its training camera, as a multiple of the training camera's distance from
            the middle of the Gaussians.
        weight: weight of the loss of an HR picture, > 0, as a multiple of a photo's LR loss.

    Raises:
        SettingError: a setting is outside its range.
    """

    start: int = milestone(5_000)
    count: int = 24
    reach: float = 0.4
    weight: float = 1.0

    def __post_init__(self) -> None:
        require_whole("count", self.count, least=0)
        for name in ("reach", "weight"):
            require_number(name, getattr(self, name), above=0)

    def on_views(self, views: Sequence[View]) -> None:
        self.cache["views"] = views

    def draw(self, t: int, means: Float[Tensor, "N 3"], enlarged: Callable[[Camera, int], Photo]) -> None:
        """Draw the pictures beside the training cameras, at the first iteration of the second stage."""
        views: Sequence[View] = self.cache.get("views", ())
        if t <= self.start or not views or "pictures" in self.cache:
            return
        if t > self.start + 1:
            _log.warning("SRStage draws its pictures at t=%d, not at t=%d: the bits are not those of an uninterrupted run.",
                         t, self.start + 1)  # fmt: skip
        self.cache["pictures"] = pictures = []
        for i in range(self.count):
            view = views[i % len(views)]
            camera = beside(view.lr.camera, means, self.reach, hashed_generator_at(self.seed, -1 - i))
            pictures.append(enlarged(camera, view.factor))

    def extra_views(self, t: int) -> Sequence[ExtraView]:
        """After `draw`, one picture at HR: a function of (seed, t) and of the field at the end of the first stage."""
        if "pictures" not in self.cache:
            return ()
        views: Sequence[View] = self.cache["views"]
        photos = [view.hr for view in views] if t % 2 or not self.count else self.cache["pictures"]
        photo: Photo = one_of(photos, hashed_generator_at(self.seed, t))
        weight = self.weight * photo.visible.to(photo.image)
        return (ExtraView(photo, weight, views[0].background, robust=True),)

    def on_fit_end(self) -> None:
        self.cache.clear()

    def summary(self) -> str | None:
        if not self.cache.get("views"):
            return None
        return f"SR images from t={self.start + 1} on, and {self.count} enlarged pictures of the field by cameras aside"
