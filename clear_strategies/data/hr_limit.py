"""What a capture of any size is trained at: the HR side has at most `ViewSettings.max_hr_megapixels`.

x4 of a phone's photo of 4032x3024 has 195 megapixels. Which factor, and which of the photos' pixels, a limit leaves:

1. `sr_scale` times the photos, where that fits.
2. Twice the photos, where that fits: every pixel of theirs is kept.
3. The photos themselves as the HR side, reduced if they are larger than the limit, and LR made from them. Nothing has to be
   super-resolved, because the photos know more than the HR side may hold.

A prior that is chosen by name is asked for SR images in any case: 3 then becomes photos that are reduced until `sr_scale` times
them fits.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.prepare import ViewSettings, resized

_log = logging.getLogger(__name__)

_TWICE: Final = 2
_MEGA: Final = 1e6
_SETTING: Final = "data.views.max_hr_megapixels"


def within_limit(
    capture: Capture, views: ViewSettings, *, reaches: Callable[[int], bool], super_resolve: bool
) -> tuple[Capture, ViewSettings]:
    """The capture, its photos reduced where they must be, and the settings that hold its HR side within the limit.

    Args:
        reaches: whether the prior enlarges by a factor.
        super_resolve: the HR side must come from the prior.
    """
    limit, largest = views.max_hr_megapixels, max(f.camera.width * f.camera.height for f in capture.frames)
    pixels = largest / views.shrink**2 / _MEGA
    if views.photos_are != "lr" or limit is None or views.sr_scale**2 * pixels <= limit:
        return capture, views
    photo = max(capture.frames, key=lambda f: f.camera.width * f.camera.height).camera
    size = f"{photo.width // views.shrink}x{photo.height // views.shrink}"
    why = f"x{views.sr_scale} of {size} is {views.sr_scale**2 * pixels:.3g} megapixels, {_SETTING} is {limit:g}"
    if views.sr_scale > _TWICE and _TWICE**2 * pixels <= limit and reaches(_TWICE):
        return _noted(capture, f"{why}: x{_TWICE} instead"), replace(views, sr_scale=_TWICE)
    factor = views.sr_scale**2 if super_resolve else 1
    ratio = views.shrink * max(1.0, math.sqrt(factor * pixels / limit))
    multiple = 1 if super_resolve else views.sr_scale
    if ratio > 1:
        capture = replace(capture, frames=_reduced(capture.frames, ratio, multiple, views.downsample))
        now = max(capture.frames, key=lambda f: f.camera.width * f.camera.height).camera
        why += f": photos reduced by {ratio:.3g} to {now.width}x{now.height} (PIL {views.downsample})"
    if super_resolve:
        return _noted(capture, why), replace(views, shrink=1)
    why += "; they are the HR side, no SR image is needed, and LR is made from them"
    return _noted(capture, why), replace(views, shrink=1, photos_are="both")


def _noted(capture: Capture, why: str) -> Capture:
    _log.debug("HR side: %s.", why)
    return replace(capture, notes={**capture.notes, "HR side": why})


def _reduced(frames: Sequence[Frame], ratio: float, multiple: int, kernel: DownKernel) -> tuple[Frame, ...]:
    """The frames with photos that are smaller by `ratio`, of sizes that are multiples of `multiple`."""
    found = []
    for frame in frames:
        size = [max(1, round(s / ratio / multiple)) * multiple for s in (frame.camera.width, frame.camera.height)]
        camera = resized(frame.camera, size[0], size[1])
        found.append(replace(frame, camera=camera, load=partial(_load, frame, (size[0], size[1]), kernel)))
    return tuple(found)


def _load(frame: Frame, size: tuple[int, int], kernel: DownKernel) -> Float[Tensor, "H W 3"]:
    return images.resize(frame.load(), size, kernel)
