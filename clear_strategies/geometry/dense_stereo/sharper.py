"""Depth of LR photos where sharper photos by the same cameras exist: those are compared, and their depth is reduced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings

_WIDER: Final = 2  # pixels that windows grow by: finer pixels hold less texture each
_MORE: Final = 1.5  # factor of planes, and of the pixels by which a point may miss itself: a point moves further
_KNOWN: Final = 0.3  # smallest share of a block whose depth is known


def depth_maps_from_sharper(
    photos: Sequence[Photo],
    sharper: Sequence[Photo],
    points: Float[Tensor, "N 3"] | None = None,
    settings: StereoSettings | None = None,
    background: tuple[float, float, float] | None = None,
) -> list[DepthMap]:
    """The depth of each photo, found by comparing `sharper`; see `depth_maps`.

    Args:
        sharper: one for each photo, a whole number of times as large; HR photos, no SR images.
        settings: as they are for the photos.
    """
    settings = settings or StereoSettings()
    finer = replace(
        settings,
        enlarge=1,
        window=settings.window + _WIDER,
        max_planes=round(_MORE * settings.max_planes),
        reprojection=_MORE * settings.reprojection,
    )
    found = depth_maps(sharper, points, finer, background)
    return [
        reduced(depth, sharp.camera.width // photo.camera.width)
        for photo, sharp, depth in zip(photos, sharper, found, strict=True)
    ]


def reduced(found: DepthMap, factor: int) -> DepthMap:
    """The median depth and the mean confidence of what is known of each block; unknown where that is too little."""
    depth, confidence = (_blocks(x, factor) for x in (found.depth, found.confidence))
    count = depth.isfinite().sum(dim=-1)
    known = count >= _KNOWN * factor**2
    return DepthMap(
        torch.where(known, depth.nanmedian(dim=-1).values, torch.nan),
        torch.where(known, confidence.sum(dim=-1) / count.clamp_min(1), 0.0),
    )


def _blocks(values: Float[Tensor, "H W"], factor: int) -> Float[Tensor, "h w n"]:
    return values.unfold(0, factor, factor).unfold(1, factor, factor).flatten(2)
