"""Pseudo views: the field also matches what cameras beside the training cameras would see.

A few photos leave much space that no camera looks through closely, and a Gaussian there costs nothing while it hides behind the
borders of the photos. A pseudo view is a training camera moved aside; its picture is warped from the photos by their depth
(`clear_strategies.geometry.pseudo_views`). Where no photo tells the colour it continues those around smoothly, and so does the
border of a training camera with a wider field: at a small weight, so that what no photo shows is neither black nor invented.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.seeds import generator_at
from clear_strategies.core.view import DepthMap, ExtraView, Photo, View
from clear_strategies.geometry.continuation import continued
from clear_strategies.geometry.pseudo_views import PseudoView, border_views, cut_out, pseudo_views
from clear_strategies.strategies.base import Strategy
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_MADE: Final = "views"
_BORDERS: Final = "borders"
_KNOWN: Final = "known"
_SEED: Final = "seed"
_BORDER_SHARE: Final = 4  # of so many extra views one is a training camera with a wider field
_TOGETHER: Final = 16_000_000  # pixels of all pseudo views, and of all borders, 16 bytes each


@dataclass(frozen=True)
class PseudoViews(Strategy):
    """Photos, warped by their depth to cameras beside theirs, as extra views.

    The depth is that of the views (`View.depth`); where a training loop has none, it comes from dense stereo.

    Args:
        every: iterations from one pseudo view to the next, at least 1.
        count: how many pseudo views are made before training, at least 1; fewer, where they would have more than 16 million
            pixels together.
        reach: largest distance of a pseudo camera from its photo's, > 0, as a multiple of the photo's median depth.
        weight: of their LR loss, > 0, as a multiple of a photo's, which is λ_LR.
        tolerance: largest relative difference, > 0, between the depth of a point and that of a photo that shows its colour.
        continued: weight of the pixels that no photo tells, in [0, 1], as a multiple of `weight`: they continue the colours
            around them smoothly. 0: they count nothing, and no border is shown.
        border: width of the training cameras' field, at least 1, where they show the continued border of their photos, as a
            multiple of the photo's. 1: no border is shown. Of many photos only every second, third … shows its border, so
            that they have at most 16 million pixels together.
        max_pixels: larger photos are first reduced by a whole factor; bounds the time of an iteration. 250,000: where depth is
            that of HR photos of 504x376 pixels, half of their size costs 0.3 dB.

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

    def on_fit_start(self, n_views: int, seed: int) -> None:
        super().on_fit_start(n_views, seed)
        self.cache[_SEED], self.cache[_MADE], self.cache[_BORDERS] = seed, (), ()

    def wants_views(self) -> bool:
        return True

    def on_views(self, views: Sequence[View]) -> None:
        """Make the pseudo views: a function of the views and the seed. None are made, and a message says why, where they
        would be of no use.
        """
        photos = {view.name: view.depth_photo.to("cpu") for view in views}
        background = views[0].background if views else (0.0, 0.0, 0.0)
        if not photos:
            _log.warning("PseudoViews has no effect: this training loop does not give its views.")
            return
        if cut_out(photos.values(), background):
            _log.info(
                "no pseudo views are made: the photos show an object before a plain background, and where a photo shows "
                "the background nothing can hide."
            )
            return
        made = self._moved_aside(views, photos)
        borders = []
        if self.continued > 0 and self.border > 1:
            fit = max(1, math.floor(_TOGETHER / (self._pixels(photos) * self.border**2)))
            some = list(photos.values())[:: math.ceil(len(photos) / fit)]
            borders = border_views(some, field=self.border, max_pixels=self.max_pixels)
        if not made:
            left = "only shows the borders of the photos" if borders else "has no effect"
            _log.warning("PseudoViews %s: stereo finds depth in fewer than two of %d photos.", left, len(photos))
        self.cache[_KNOWN] = sum(float(view.known.float().mean()) for view in made) / max(1, len(made))
        self.cache[_MADE] = tuple(self._target(view, background) for view in made)
        self.cache[_BORDERS] = tuple(self._target(view, background) for view in borders)

    def _moved_aside(self, views: Sequence[View], photos: dict[str, Photo]) -> list[PseudoView]:
        if len(photos) < 2:
            return []
        return pseudo_views(
            photos,
            _depths(views, photos),
            count=max(1, min(self.count, _TOGETHER // self._pixels(photos))),
            reach=self.reach,
            tolerance=self.tolerance,
            max_pixels=self.max_pixels,
            background=views[0].background,
            seed=self.cache[_SEED],
        )

    def _pixels(self, photos: dict[str, Photo]) -> int:
        """Of the largest photo, reduced to `max_pixels`."""
        return max(p.camera.width * p.camera.height // p.factor_to(self.max_pixels) ** 2 for p in photos.values())

    def _target(self, view: PseudoView, background: Color) -> ExtraView:
        weight = torch.where(view.known, 1.0, self.continued if bool(view.known.any()) else 0.0) * self.weight
        image = continued(view.photo.image, view.known) if self.continued > 0 else view.photo.image
        return ExtraView(replace(view.photo, image=image), weight, background).to(self.device)

    def extra_views(self, t: int) -> Sequence[ExtraView]:
        """One of them every `every` iterations: a function of (seed, t)."""
        made: Sequence[ExtraView] = self.cache.get(_MADE, ())
        borders: Sequence[ExtraView] = self.cache.get(_BORDERS, ())
        if not (made or borders) or t % self.every:
            return ()
        generator = generator_at(self.cache[_SEED], t)

        def drawn(n: int) -> int:
            return int(torch.randint(n, (), generator=generator))

        among = borders if borders and not (made and drawn(_BORDER_SHARE)) else made
        return (among[drawn(len(among))],)

    def on_fit_end(self) -> None:
        self.cache[_MADE] = self.cache[_BORDERS] = ()

    def summary(self) -> str | None:
        made, borders = (len(self.cache.get(which, ())) for which in (_MADE, _BORDERS))
        if not (made or borders):
            return None
        beside = f"{made} beside the training cameras, {self.cache[_KNOWN]:.0%} of their pixels known, " if made else ""
        wide = f"{borders} with a field {self.border:g} times as wide, " if borders else ""
        return f"{beside}{wide}one every {self.every} iterations"

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        return "it is the LR loss that pseudo views are trained by, and lambda_lr is 0" if lambda_lr == 0 else None


def _depths(views: Sequence[View], photos: dict[str, Photo]) -> dict[str, DepthMap]:
    """The depth of each photo, on the CPU: that of its view, or where no view has any, that of stereo."""
    known = {view.name: view.depth.to("cpu") for view in views if view.depth is not None}
    if known:
        return known
    from clear_strategies.geometry import depth_maps

    return dict(zip(photos, depth_maps(list(photos.values()), background=views[0].background), strict=True))
