"""Pseudo views: the field also matches what cameras beside the training cameras would see.

A few photos leave much space that no camera looks through closely, and a Gaussian there costs nothing while it hides behind the
borders of the photos. A pseudo view is a training camera moved aside; its picture is warped from the photos by their depth
(`clear_strategies.geometry.pseudo_views`), and has weight 0 where no photo tells the colour.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch

from clear_strategies.core.view import DepthMap, ExtraView, Photo, View
from clear_strategies.errors import SettingError
from clear_strategies.geometry.pseudo_views import cut_out, pseudo_views
from clear_strategies.strategies.base import Strategy

_log = logging.getLogger(__name__)

_MADE: Final = "views"
_SEED: Final = "seed"


@dataclass(frozen=True)
class PseudoViews(Strategy):
    """LR photos, warped by their depth to cameras beside theirs, as extra views.

    The depth is that of the views (`View.depth`); where a training loop has none, it comes from dense stereo.

    Args:
        every: iterations from one pseudo view to the next, at least 1.
        count: how many pseudo views are made before training, at least 1.
        reach: largest distance of a pseudo camera from its photo's, > 0, as a multiple of the photo's median depth.
        weight: of their LR loss, > 0, as a multiple of a photo's, which is λ_LR.
        tolerance: largest relative difference, > 0, between the depth of a point and that of a photo that shows its colour.
        max_pixels: larger LR photos are first reduced by a whole factor; bounds time and memory.

    Raises:
        SettingError: a setting is outside its range.
    """

    every: int = 2
    count: int = 256
    reach: float = 1.2
    weight: float = 1.0
    tolerance: float = 0.02
    max_pixels: int = 64_000

    def __post_init__(self) -> None:
        for name in ("every", "count", "max_pixels"):
            if getattr(self, name) < 1:
                raise SettingError(f"{name} must be at least 1, got {getattr(self, name)}.")
        for name in ("reach", "weight", "tolerance"):
            if not getattr(self, name) > 0:
                raise SettingError(f"{name} must be > 0, got {getattr(self, name)}.")

    def on_fit_start(self, n_views: int, seed: int) -> None:
        super().on_fit_start(n_views, seed)
        self.cache[_SEED], self.cache[_MADE] = seed, ()

    def wants_views(self) -> bool:
        return True

    def on_views(self, views: Sequence[View]) -> None:
        """Make the pseudo views: a function of the views and the seed. None are made, and a message says why, where they
        would be of no use.
        """
        photos = {view.name: view.lr.to("cpu") for view in views}
        background = views[0].background if views else (0.0, 0.0, 0.0)
        if len(photos) < 2:
            given = f"there are {len(photos)}" if photos else "this training loop does not give its views"
            _log.warning("PseudoViews has no effect: at least two training views are needed, %s.", given)
            return
        if cut_out(photos.values(), background):
            _log.info(
                "no pseudo views are made: the photos show an object before a plain background, and where a photo shows "
                "the background nothing can hide."
            )
            return
        made = pseudo_views(
            photos,
            _depths(views, photos),
            count=self.count,
            reach=self.reach,
            tolerance=self.tolerance,
            max_pixels=self.max_pixels,
            background=background,
            seed=self.cache[_SEED],
        )
        if not made:
            _log.warning("PseudoViews has no effect: stereo finds depth in fewer than two of %d photos.", len(photos))
        self.cache[_MADE] = tuple(
            ExtraView(view.photo, view.known * self.weight).to(self.device) for view in made
        )  # fmt: skip

    def extra_views(self, t: int) -> Sequence[ExtraView]:
        """One of them every `every` iterations: a function of (seed, t)."""
        made: Sequence[ExtraView] = self.cache.get(_MADE, ())
        if not made or t % self.every:
            return ()
        generator = torch.Generator().manual_seed(self.cache[_SEED] * 1_000_003 + t)
        return (made[int(torch.randint(len(made), (), generator=generator))],)

    def on_fit_end(self) -> None:
        self.cache[_MADE] = ()

    def summary(self) -> str | None:
        made: Sequence[ExtraView] = self.cache.get(_MADE, ())
        if not made:
            return None
        known = sum(float((view.weight > 0).float().mean()) for view in made) / len(made)
        return f"{len(made)} beside the training cameras, {known:.0%} of their pixels known, one every {self.every} iterations"

    def without_effect(self, *, lambda_lr: float, lambda_hr: float) -> str | None:
        return "it is the LR loss that pseudo views are trained by, and lambda_lr is 0" if lambda_lr == 0 else None


def _depths(views: Sequence[View], photos: dict[str, Photo]) -> dict[str, DepthMap]:
    """The depth of each photo, on the CPU: that of its view, or where no view has any, that of stereo."""
    known = {view.name: view.depth.to("cpu") for view in views if view.depth is not None}
    if known:
        return known
    from clear_strategies.geometry import depth_maps

    return dict(zip(photos, depth_maps(list(photos.values()), background=views[0].background), strict=True))
