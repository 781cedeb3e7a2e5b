"""The size at which stereo compares the photos, and the photos that depth maps are made for.

HR shows more than LR, so stereo at HR finds more depth, and more precisely. Where the HR images are photos, depth maps have
their size. SR images also show what the network invented, so depth maps then have the size of the LR photos, and SR depth only
fills the pixels where the LR photos agree on none, with the median of each LR pixel's block. SR images of an object before a
plain background are not compared: they mix both along its outline, and depth there is wrong (lego loses 0.18 dB by it).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.pseudo_views import cut_out
from rasterizers.interface import Color


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """The images that stereo compares, and the photos that depth maps are made for.

    Args:
        reduction: pixels of `images` along one of `photos`.
        finer: size of `photos` as a multiple of LR.
        settings: for depth maps of the size of `photos`, and the cloud that is made from them.
    """

    images: Sequence[Photo]
    photos: Sequence[Photo]
    reduction: int
    finer: float
    settings: StereoSettings

    def depth_maps(self, points: Float[Tensor, "N 3"], background: Color | None) -> tuple[DepthMap, ...]:
        """A map for each of `photos`; `points` and `background` as in `clear_strategies.geometry.depth_maps`."""
        maps = depth_maps(self.photos, points, self.settings, background, shown_pixels(self.photos))
        if self.reduction > 1:
            finer = self.settings.finer(self.reduction)
            finest = depth_maps(self.images, points, finer, background, shown_pixels(self.images))
            maps = [lr.completed_by(sr.reduced(self.reduction)) for lr, sr in zip(maps, finest, strict=True)]
        return tuple(maps)


def compared_at(
    lr: Sequence[Photo],
    hr: Sequence[Photo],
    *,
    hr_is_photo: bool,
    settings: StereoSettings,
    background: Color = (0.0, 0.0, 0.0),
) -> Compared:
    """HR, reduced to at most `settings.max_pixels`, where that is larger than LR; else LR.

    Args:
        hr: the same views at HR; empty: LR is compared.
        hr_is_photo: the HR images are photos, not SR images.
        background: of the scene, RGB in [0, 1].
    """
    only_lr = Compared(lr, lr, 1, 1.0, settings)
    if not hr:
        return only_lr
    if hr_is_photo:
        photos = [photo.reduced(photo.factor_to(settings.max_pixels)) for photo in hr]
        finer = photos[0].camera.width / lr[0].camera.width
        return Compared(photos, photos, 1, finer, settings.finer(finer)) if finer > 1 else only_lr
    if cut_out(lr, background):
        return only_lr
    factor = hr[0].camera.width // lr[0].camera.width
    least = max(photo.factor_to(settings.max_pixels) for photo in hr)
    reduced = next((k for k in range(least, factor) if factor % k == 0), factor)
    if reduced >= factor:
        return only_lr
    return Compared([photo.reduced(reduced) for photo in hr], lr, factor // reduced, 1.0, settings)


def shown_pixels(photos: Sequence[Photo]) -> list[Bool[Tensor, "h w"]]:
    """The mask of each photo; all True where it has none."""
    return [
        torch.ones(photo.image.shape[:2], dtype=torch.bool) if photo.shown is None else photo.shown for photo in photos
    ]


def blackened(photo: Photo) -> Photo:
    """The photo with black in place of what its mask hides, where no features are found then."""
    return photo if photo.shown is None else replace(photo, image=photo.image * photo.shown[..., None])
