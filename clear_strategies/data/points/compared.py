"""At which size the photos are compared, and what becomes of the depth that is found there.

HR shows more than LR, so stereo at HR finds more depth, and more precisely. Where HR is photos, everything is made at their size.
An SR image holds what a network made up, too: its depth only completes that of the LR photos. Where these do not agree on one, a
pixel of LR has the median depth of its block of SR pixels. Not so for an object before a plain background: along its outline SR
images mix both, and their depth there is wrong (lego loses 0.18 dB by it).
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
    """What stereo compares, and what its depth is for.

    Args:
        images: what it compares. photos: whose depth maps are made.
        reduction: pixels of `images` along one of `photos`.
        finer: size of `photos` as a multiple of LR.
        settings: of the cloud that is made of the maps.
    """

    images: Sequence[Photo]
    photos: Sequence[Photo]
    reduction: int
    finer: float
    settings: StereoSettings

    def depth_maps(self, points: Float[Tensor, "N 3"], background: Color | None) -> tuple[DepthMap, ...]:
        """A map for each of `photos`. `points` and `background` as in `depth_maps` of the package geometry."""
        if self.reduction == 1:
            return self._maps(self.images, points, background, self.settings)
        finest = self._maps(self.images, points, background, self.settings.finer(self.reduction))
        of_photos = self._maps(self.photos, points, background, self.settings)
        return tuple(
            own.completed_by(fine.reduced(self.reduction)) for own, fine in zip(of_photos, finest, strict=True)
        )

    def _maps(
        self, photos: Sequence[Photo], points: Float[Tensor, "N 3"], background: Color | None, settings: StereoSettings
    ) -> tuple[DepthMap, ...]:
        return tuple(depth_maps(photos, points, settings, background, self.masks(photos)))

    def masks(self, photos: Sequence[Photo]) -> list[Bool[Tensor, "h w"]] | None:
        """Where each photo shows its pixels; None where all of them do."""
        return None if all(photo.shown is None for photo in photos) else [_shown(photo) for photo in photos]


def compared_at(
    lr: Sequence[Photo],
    hr: Sequence[Photo],
    *,
    hr_is_photo: bool,
    settings: StereoSettings,
    background: Color = (0.0, 0.0, 0.0),
) -> Compared:
    """The choice for these photos: HR, reduced to at most `settings.max_pixels`, where that is larger than LR, else LR.

    Args:
        hr: the same views at HR; none: LR is compared.
        hr_is_photo: HR is photos, not SR images.
        background: of the scene, RGB in [0, 1].
    """
    whole = Compared(lr, lr, 1, 1.0, settings)
    if not hr:
        return whole
    if hr_is_photo:
        photos = [photo.reduced(photo.factor_to(settings.max_pixels)) for photo in hr]
        finer = photos[0].camera.width / lr[0].camera.width
        return Compared(photos, photos, 1, finer, settings.finer(finer)) if finer > 1 else whole
    if cut_out(lr, background):
        return whole
    factor = hr[0].camera.width // lr[0].camera.width
    least = max(photo.factor_to(settings.max_pixels) for photo in hr)
    reduced = next((k for k in range(least, factor) if factor % k == 0), factor)
    if reduced >= factor:
        return whole
    return Compared([photo.reduced(reduced) for photo in hr], lr, factor // reduced, 1.0, settings)


def blackened(photo: Photo) -> Photo:
    """The photo with black in place of what is hidden: it has no features."""
    return photo if photo.shown is None else replace(photo, image=photo.image * photo.shown[..., None])


def _shown(photo: Photo) -> Bool[Tensor, "h w"]:
    return torch.ones(photo.image.shape[:2], dtype=torch.bool) if photo.shown is None else photo.shown
