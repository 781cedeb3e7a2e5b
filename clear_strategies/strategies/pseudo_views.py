"""Pseudo views: the field also matches pictures from cameras beside the training cameras.

With few photos, much of the space near the cameras is in no photo, and a Gaussian there causes no loss. A pseudo view is a
training camera moved aside; its picture is warped from the photos by their depth (`clear_strategies.geometry.pseudo_views`).
Pixels that no photo shows continue the surrounding colours smoothly, with a small weight, so that they are neither black nor
invented. So do the pixels beyond the border of a photo in a training camera with a wider field.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Final

import torch

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.seeds import generator_at, one_of
from clear_strategies.core.view import DepthMap, ExtraView, Photo, View
from clear_strategies.geometry.photos import cut_out
from clear_strategies.geometry.pseudo_views import border_view, continued, pseudo_views
from clear_strategies.strategies.base import Strategy
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_BORDER_SHARE: Final = 4  # of so many extra views one is a training camera with a wider field
_TOGETHER: Final = 16_000_000  # pixels of all pseudo views, and of all borders, 16 bytes each


@dataclass(frozen=True)
class PseudoViews(Strategy):
    """Photos, warped by their depth to cameras beside theirs, as extra views.

    The depth is that of the views (`View.depth`); if a training loop has none, it comes from dense stereo.

    Args:
        every: iterations from one pseudo view to the next, at least 1.
        count: the number of different pseudo views, at least 1; fewer if they would have more than 16 million pixels together.
        reach: largest distance of a pseudo camera from its photo's, > 0, as a multiple of the photo's median depth.
        weight: weight of the LR loss of a pseudo view, > 0, as a multiple of λ_LR.
        tolerance: largest relative difference, > 0, between the depth of a point and that of a photo that shows its colour.
        continued: weight of the pixels that no photo shows, in [0, 1], as a multiple of `weight`: they continue the surrounding
            colours smoothly. 0: they have no weight, and there are no views of borders.
        border: field of view of the training cameras that show the continued border of their photos, at least 1, as a multiple of
            the photo's. 1: there are no such views. Of many photos only every second, third … has one, so that they have at most
            16 million pixels together.
        max_pixels: larger photos are first reduced by a whole factor, which bounds the time of an iteration. 250,000, since for
            HR photos of 504x376 pixels with depth, half of their size costs 0.3 dB.

    Raises:
        SettingError: a setting is outside its range.
    """

    every: int = 2
    count: int = 256
    reach: float = 1.2
    weight: float = 1.0
    tolerance: float = 0.02
    continued: float = 0.1
    border: float = 1.3
    max_pixels: int = 250_000

    def __post_init__(self) -> None:
        for name in ("every", "count", "max_pixels"):
            require_whole(name, getattr(self, name), least=1)
        for name in ("reach", "weight", "tolerance"):
            require_number(name, getattr(self, name), above=0)
        require_number("continued", self.continued, most=1)
        require_number("border", self.border, least=1)

    def on_views(self, views: Sequence[View]) -> None:
        """Choose the pseudo views as a function of the views and the seed. Each is made in the first iteration that uses it. If
        they would be of no use, there are none, and a message says why.
        """
        if not views:
            _log.warning("PseudoViews has no effect: this training loop does not give its views.")
            return
        photos = {view.name: view.depth_photo.to(self.device) for view in views}
        background = views[0].background
        if cut_out(photos.values(), background):
            _log.info(
                "pseudo_views is off: the photos show an object before a plain background, where pseudo views lower the PSNR."
            )
            return
        aside, borders = self._moved_aside(views, photos), []
        if self.continued > 0 and self.border > 1:
            fit = max(1, math.floor(_TOGETHER / (self._pixels(photos) * self.border**2)))
            wider = partial(border_view, field=self.border, max_pixels=self.max_pixels)
            borders = [partial(wider, photo) for photo in list(photos.values())[:: math.ceil(len(photos) / fit)]]
        if not aside:
            left = "only shows the borders of the photos" if borders else "has no effect"
            _log.warning("PseudoViews %s: stereo finds depth in fewer than two of %d photos.", left, len(photos))
        self.cache.update(
            views=tuple(cache(partial(self._target, make, background)) for make in aside),
            borders=tuple(cache(partial(self._target, make, background)) for make in borders),
        )

    def _moved_aside(self, views: Sequence[View], photos: dict[str, Photo]) -> list[Callable[[], Photo]]:
        return pseudo_views(
            photos,
            {name: depth.to(self.device) for name, depth in _depths(views).items()},
            count=max(1, min(self.count, _TOGETHER // self._pixels(photos))),
            reach=self.reach,
            tolerance=self.tolerance,
            max_pixels=self.max_pixels,
            background=views[0].background,
            seed=self.seed,
        )

    def _pixels(self, photos: dict[str, Photo]) -> int:
        """The pixels of the largest photo, reduced to `max_pixels`."""
        return max(p.camera.width * p.camera.height // p.factor_to(self.max_pixels) ** 2 for p in photos.values())

    def _target(self, make: Callable[[], Photo], background: Color) -> ExtraView:
        photo = make()
        known = photo.visible
        weight = torch.where(known, 1.0, self.continued if bool(known.any()) else 0.0) * self.weight
        image = continued(photo.image, known) if self.continued > 0 else photo.image
        return ExtraView(replace(photo, image=image, shown=None), weight, background)

    def extra_views(self, t: int) -> Sequence[ExtraView]:
        """One view every `every` iterations, a function of (seed, t)."""
        aside: Sequence[Callable[[], ExtraView]] = self.cache.get("views", ())
        borders: Sequence[Callable[[], ExtraView]] = self.cache.get("borders", ())
        if not (aside or borders) or t % self.every:
            return ()
        generator = generator_at(self.seed, t)
        choices = aside if aside and (not borders or one_of(range(_BORDER_SHARE), generator) > 0) else borders
        return (one_of(choices, generator)(),)

    def on_fit_end(self) -> None:
        self.cache["views"] = self.cache["borders"] = ()

    def summary(self) -> str | None:
        aside, borders = (len(self.cache.get(name, ())) for name in ("views", "borders"))
        if not (aside or borders):
            return None
        moved = f"{aside} beside the training cameras, " if aside else ""
        wide = f"{borders} with a field {self.border:g} times as wide, " if borders else ""
        return f"{moved}{wide}one every {'iteration' if self.every == 1 else f'{self.every} iterations'}"


def _depths(views: Sequence[View]) -> dict[str, DepthMap]:
    """The depth of each photo: that of its view or, if no view has depth, from stereo."""
    known = {view.name: view.depth for view in views if view.depth is not None}
    if known:
        return known
    from clear_strategies.geometry import depth_maps

    photos = [view.depth_photo.to("cpu") for view in views]
    return {view.name: m for view, m in zip(views, depth_maps(photos, background=views[0].background), strict=True)}
