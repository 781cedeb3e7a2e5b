"""The depth map of each photo: plane sweep, smoothing, confirmation by other photos, checks."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.progress import told
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.dense_stereo.cloud import points_of
from clear_strategies.geometry.dense_stereo.consistency import Estimate, confirm, speckles
from clear_strategies.geometry.dense_stereo.cost import Grey, cost_volume, grey
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.dense_stereo.smoothing import smooth
from clear_strategies.geometry.dense_stereo.sources import Comparison, comparisons, plane_count
from clear_strategies.geometry.photos import each_photo, is_background
from clear_strategies.geometry.projection import seen_pixels
from clear_strategies.geometry.sift import features_of
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_MANY_PHOTOS = 12  # number of photos from which two others must agree, if so many see a point
_CONFIRMING = 8  # largest number of photos that confirm the depth of one
_FEW_POINTS = 10  # triangulated points in a photo, below which its depth is not checked by them
_LIKE = 0.05  # relative difference of depth up to which neighbouring pixels show one surface
_CLOSE = 0.1  # relative error up to which depth agrees with a triangulated point


def depth_maps(
    photos: Sequence[Photo],
    points: Float[Tensor, "N 3"] | None = None,
    settings: StereoSettings | None = None,
    background: Color | None = None,
) -> list[DepthMap]:
    """Compute the depth of each photo where others confirm it; unknown everywhere for photos whose stereo is not plausible.

    Args:
        photos: posed, of any sizes, on one device. Pixels that their masks hide get no depth.
        points: of the surfaces, world units: they give the range of depth, and the result is checked against them. If empty,
            the cameras give a range, and the depth found there a better one. None: features are triangulated if OpenCV, kornia
            and SciPy are installed.
        background: the colour of pixels without a surface, RGB in [0, 1].

    Returns:
        A map for each photo, of its size and on its device.
    """
    settings = settings or StereoSettings()
    if points is None:
        points = features_of(photos).means
    maps = _maps(photos, points.cpu(), settings, background)
    if len(points) or not len(found := points_of(photos, maps, settings.spacing, settings.tolerance)[0]):
        return maps
    return _maps(photos, found, settings, background)


def _maps(
    photos: Sequence[Photo], points: Float[Tensor, "N 3"], settings: StereoSettings, background: Color | None
) -> list[DepthMap]:
    compared = comparisons(photos, points, max(_CONFIRMING, settings.sources))
    estimates = _estimates(photos, compared, settings)
    needed = settings.agreeing or (2 if len(photos) >= _MANY_PHOTOS else 1)
    maps = []
    for i, (photo, estimate) in enumerate(zip(photos, estimates, strict=True)):
        if estimate is None:
            maps.append(_unknown(photo, "no other photo sees the same surfaces from 1 to 45 degrees aside"))
            continue
        others = [e for j in compared[i].others[:_CONFIRMING] if (e := estimates[j]) is not None]
        agreeing, seeing, inverse_depth = confirm(estimate, others, settings)
        # Photos that look outward overlap with their neighbours alone: of many, too, one other may see a point.
        good = (agreeing >= seeing.clamp(1, needed)) & (estimate.correlation >= settings.min_correlation)
        if background is not None:
            good &= ~is_background(photo.image, background)
        good &= photo.visible
        confidence = estimate.correlation.clamp(0, 1) * (agreeing.float() / 2).clamp(max=1)
        depth = torch.where(good, 1 / inverse_depth, torch.nan)
        good &= ~speckles(depth, settings.speckle, _LIKE)
        depth_map = DepthMap(torch.where(good, depth, torch.nan), torch.where(good, confidence, 0.0))
        maps.append(_checked(photo, depth_map, points, settings))
    return maps


def _estimates(
    photos: Sequence[Photo], compared: Sequence[Comparison], settings: StereoSettings
) -> list[Estimate | None]:
    """The depth of each photo at its pixels, from its own plane sweep; None if there is no photo to compare it with."""
    greys = [grey(photo, settings.enlarge, settings.max_pixels) for photo in photos]

    def estimate(i: int) -> Estimate | None:
        comparison = compared[i]
        if not (others := [greys[j] for j in comparison.others[: settings.sources]]):
            return None
        _log.debug("stereo: photo %d against %s.", i, comparison.others[: settings.sources])
        return _on_photo(plane_sweep(greys[i], others, comparison, settings), photos[i])

    return list(told(each_photo(estimate, photos), "depth by stereo", "photos", len(photos)))


def plane_sweep(image: Grey, others: list[Grey], comparison: Comparison, settings: StereoSettings) -> Estimate:
    """Sweep planes uniform in inverse depth, and take the minimum of the smoothed cost, refined by a parabola."""
    count = plane_count(image.camera, [other.camera for other in others], comparison, settings)
    planes = torch.linspace(comparison.far, comparison.near, count, dtype=torch.float64)
    cost = cost_volume(image, others, planes.to(image.image), settings.window)
    smoothed = smooth(cost, image.image, settings.small_step, settings.large_step)
    best = smoothed.argmin(dim=-1, keepdim=True)
    correlation = 1 - 2 * cost.gather(-1, best)[..., 0]
    step = (comparison.near - comparison.far) / (count - 1)
    position = best[..., 0].double() + parabola_minimum(smoothed, best).double()
    return Estimate(image, (comparison.far + step * position).float(), correlation)


def parabola_minimum(cost: Float[Tensor, "H W D"], best: Tensor) -> Float[Tensor, "H W"]:
    """The lowest point of the parabola through the minimum and its two neighbours, in [-0.5, 0.5] planes from the minimum."""
    last = cost.shape[-1] - 1
    before, here, after = (cost.gather(-1, (best + k).clamp(0, last))[..., 0] for k in (-1, 0, 1))
    curvature = (before - 2 * here + after).clamp_min(1e-9)
    offset = ((before - after) / (2 * curvature)).clamp(-0.5, 0.5)
    inside = (best[..., 0] > 0) & (best[..., 0] < last)
    return torch.where(inside, offset, 0.0)


def _on_photo(estimate: Estimate, photo: Photo) -> Estimate:
    """Resample the estimate of an enlarged or reduced image at the photo's pixels: the best correlated of those each covers."""
    camera, swept = photo.camera, estimate.image.camera
    image = Grey(camera, photo.image.new_zeros(camera.height, camera.width))
    if (camera.height, camera.width) == tuple(estimate.inverse_depth.shape):
        return replace(estimate, image=image)
    if swept.width > camera.width:
        k = swept.width // camera.width
        best = torch.nn.functional.max_pool2d(estimate.correlation[None, None], k, return_indices=True)[1][0, 0]
        return Estimate(image, *(x.reshape(-1)[best] for x in (estimate.inverse_depth, estimate.correlation)))
    row, column = (
        ((torch.arange(full) + 0.5) * (f / g)).long().clamp(max=last - 1)
        for full, f, g, last in (
            (camera.height, swept.fy, camera.fy, swept.height), (camera.width, swept.fx, camera.fx, swept.width),
        )
    )  # fmt: skip
    return Estimate(image, *(x[row[:, None], column] for x in (estimate.inverse_depth, estimate.correlation)))


def _checked(photo: Photo, depth_map: DepthMap, points: Float[Tensor, "N 3"], settings: StereoSettings) -> DepthMap:
    """Return the depth map, or an unknown one if it covers too few pixels or contradicts the triangulated points."""
    if depth_map.coverage < settings.trust:
        return _unknown(photo, f"its depth is confirmed at only {depth_map.coverage:.1%} of the pixels")
    _, row, column, depth = seen_pixels(photo.camera, points)
    # A point behind the surface may be occluded, so only points in front of it contradict the depth.
    ratio = depth_map.depth.cpu()[row, column] / depth
    ratio = ratio[ratio.isfinite()]
    contradictions = float((ratio > 1 + _CLOSE).float().mean()) if len(ratio) >= _FEW_POINTS else 0.0
    if contradictions > 0.5:
        return _unknown(photo, f"{contradictions:.0%} of the triangulated points lie in front of its depth")
    return depth_map


def _unknown(photo: Photo, reason: str) -> DepthMap:
    _log.debug("stereo: a photo of %dx%d is left out: %s.", photo.camera.width, photo.camera.height, reason)
    shape = (photo.camera.height, photo.camera.width)
    return DepthMap(photo.image.new_full(shape, torch.nan), photo.image.new_zeros(shape))
