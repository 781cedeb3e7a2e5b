"""Keep the HR images within `ViewSettings.max_hr_megapixels`, whatever the size of the photos.

A phone's photo has 4032x3024 pixels; four times as wide and as high, it would have 195 megapixels. The first of these that
fits into the limit is taken:

1. The HR images are `sr_scale` times as large as the photos.
2. They are twice as large as the photos, which keep all of their pixels. The prior must be able to enlarge by 2.
3. The photos are the HR images, reduced if they are larger than the limit, and the LR images are made from them. No image is
   super-resolved: the photos already hold more detail than the HR images may.

If the user has chosen a prior by name, SR images are always made. In place of 3, the photos are then reduced until `sr_scale`
times their size fits. Where sizes differ, the largest photo decides, and each photo is reduced to the limit by itself: one
ratio would leave little of a phone's 12 megapixels beside 48.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.view_settings import ViewSettings, resized
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_TWICE: Final = 2
_MEGA: Final = 1e6
_SETTING: Final = "data.views.max_hr_megapixels"


def within_limit(
    capture: Capture, views: ViewSettings, *, reaches: Callable[[int], bool], super_resolve: bool
) -> tuple[Capture, ViewSettings]:
    """Reduce the photos and choose the factor so that the HR images fit into `views.max_hr_megapixels`.

    Both are returned unchanged where the HR images fit or `photos_are` is not "lr".

    Args:
        reaches: whether the prior can enlarge by a factor.
        super_resolve: the HR images must come from the prior, even if the photos are large enough.
    """
    limit, photo = views.max_hr_megapixels, _largest(capture)
    pixels = _megapixels(photo, views)
    if views.photos_are != "lr" or limit is None or views.sr_scale**2 * pixels <= limit:
        return capture, views
    size = f"{photo.width // views.shrink}x{photo.height // views.shrink}"
    why = f"x{views.sr_scale} of {size} is {views.sr_scale**2 * pixels:.3g} megapixels, {_SETTING} is {limit:g}"
    if views.sr_scale > _TWICE and _TWICE**2 * pixels <= limit and reaches(_TWICE):
        return _noted(capture, f"{why}: x{_TWICE} instead"), replace(views, sr_scale=_TWICE)
    factor = views.sr_scale**2 if super_resolve else 1
    multiple = 1 if super_resolve else views.sr_scale
    ratios = [views.shrink * max(1.0, math.sqrt(factor * _megapixels(f.camera, views) / limit)) for f in capture.frames]
    if max(ratios) > 1:
        frames = [_reduced(f, r, multiple, views.downsample) for f, r in zip(capture.frames, ratios, strict=True)]
        capture = replace(capture, frames=tuple(frames))
        now = _largest(capture)
        span = f"{max(ratios):.3g}" if max(ratios) == min(ratios) else f"{min(ratios):.3g} to {max(ratios):.3g}"
        why += f": photos reduced by {span} to {now.width}x{now.height} (PIL {views.downsample})"
    if not super_resolve:
        why += "; they are the HR side, no SR image is needed, and LR is made from them"
        views = replace(views, photos_are="both")
    return _noted(capture, why), replace(views, shrink=1)


def _megapixels(camera: Camera, views: ViewSettings) -> float:
    return camera.width * camera.height / views.shrink**2 / _MEGA


def _largest(capture: Capture) -> Camera:
    return max((frame.camera for frame in capture.frames), key=lambda camera: camera.width * camera.height)


def _noted(capture: Capture, why: str) -> Capture:
    _log.debug("HR side: %s.", why)
    return replace(capture, notes={**capture.notes, "HR side": why})


def _reduced(frame: Frame, ratio: float, multiple: int, kernel: DownKernel) -> Frame:
    """The frame with a photo `ratio` times smaller, rounded to a size that `multiple` divides."""
    width, height = (max(1, round(s / ratio / multiple)) * multiple for s in (frame.camera.width, frame.camera.height))
    camera = resized(frame.camera, width, height)
    return replace(frame, camera=camera, load=lambda: images.resize(frame.load(), (width, height), kernel))
