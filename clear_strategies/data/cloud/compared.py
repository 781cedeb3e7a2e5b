"""The size at which stereo compares the photos, and the photos that depth maps are made for.

HR shows more than LR, so stereo at HR finds more depth, and more precisely. Where the HR images are photos, depth maps have
their size. SR images also show what the network invented, so depth maps then have the size of the LR photos, and SR depth only
fills the pixels where the LR photos agree on none, with the median of each LR pixel's block. SR images of an object before a
plain background are not compared: they mix both along its outline, and depth there is wrong (lego loses 0.18 dB by it).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.pseudo_views import cut_out
from rasterizers.interface import Color


class Depths(NamedTuple):
    """Photos and their depth maps; the settings for a cloud of them, and their size as a multiple of LR."""

    photos: Sequence[Photo]
    maps: tuple[DepthMap, ...]
    settings: StereoSettings
    finer: float = 1.0


def stereo_depths(
    lr: Sequence[Photo],
    hr: Sequence[Photo],
    points: Float[Tensor, "N 3"],
    settings: StereoSettings,
    *,
    hr_is_photo: bool,
    background: Color | None = None,
) -> Depths:
    """Depth from HR, reduced to at most `settings.max_pixels`, where that is larger than LR; else from LR.

    Args:
        hr: the same views at HR; empty: LR is compared.
        points, background: as in `clear_strategies.geometry.depth_maps`.
        hr_is_photo: the HR images are photos, not SR images.
    """
    if hr and hr_is_photo:
        photos = [photo.reduced(photo.factor_to(settings.max_pixels)) for photo in hr]
        if (finer := photos[0].camera.width / lr[0].camera.width) > 1:
            of_hr = settings.finer(finer)
            return Depths(photos, tuple(depth_maps(photos, points, of_hr, background)), of_hr, finer)
    maps = depth_maps(lr, points, settings, background)
    if hr and not hr_is_photo and not cut_out(lr, background or (0.0, 0.0, 0.0)):
        factor = hr[0].camera.width // lr[0].camera.width
        least = max(photo.factor_to(settings.max_pixels) for photo in hr)
        by = next((factor // k for k in range(least, factor) if factor % k == 0), 1)
        if by > 1:
            images = [photo.reduced(factor // by) for photo in hr]
            finest = depth_maps(images, points, settings.finer(by), background)
            maps = [map_lr.completed_by(map_sr.reduced(by)) for map_lr, map_sr in zip(maps, finest, strict=True)]
    return Depths(lr, tuple(maps), settings)
