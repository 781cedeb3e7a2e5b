"""Equalization of exposure and white balance: a gain per photo and channel, from the colours of surfaces that photos share.

A camera that chooses its exposure for each photo multiplies linear light, and so does white balance. Where the sRGB curve is
close to a power, the photo is multiplied by a power of the same number: one gain per channel describes both.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.cameras import partners
from clear_strategies.geometry.photos import each_photo
from clear_strategies.geometry.projection import back_project, inside, project, sample_colors

_TOLERANCE: Final = 0.02  # relative difference of depth up to which two photos show the same surface
_UNCLIPPED: Final = (0.05, 0.92)  # darker pixels are mostly noise, lighter ones may be clipped
_FEWEST: Final = 100  # shared pixels of a pair, per channel


def exposure_gains(photos: Sequence[Photo], depths: Sequence[DepthMap]) -> Float[Tensor, "V 3"]:
    """Compute the gains that bring the photos to a common exposure: photo × gain.

    For each pair of a photo and one of its `partners`, the median ratio of the colours of shared surfaces is measured; least
    squares over all pairs gives a gain per photo. Over photos that are connected by pairs, the gains of a channel have the
    geometric mean 1. A photo that shares no surface with another has the gain 1.

    Args:
        depths: of the photos, on their pixels.
    """
    device = photos[0].image.device if photos else "cpu"
    others = partners([photo.camera for photo in photos])
    pairs = [(a, b) for a, row in enumerate(others) for b in row]
    if not pairs:
        return torch.ones(len(photos), 3, device=device)
    photos, depths = [photo.to("cpu") for photo in photos], [depth.to("cpu") for depth in depths]
    measured = each_photo(lambda a: _ratios(photos[a], depths[a], [(photos[b], depths[b]) for b in others[a]]), photos)
    ratios, weights = map(torch.stack, zip(*itertools.chain.from_iterable(measured), strict=True))  # [pairs, 3]
    difference = torch.zeros(len(pairs), len(photos), dtype=torch.float64)
    for i, (a, b) in enumerate(pairs):
        difference[i, a], difference[i, b] = 1, -1
    root = weights.sqrt()
    # The pseudo-inverse has the least norm: the mean of the logarithms, which no pair determines, is 0.
    logs = [torch.linalg.pinv(root[:, c, None] * difference) @ (root[:, c] * ratios[:, c]) for c in range(3)]
    return torch.exp(-torch.stack(logs, dim=1)).float().to(device)


def _ratios(
    photo: Photo, depth: DepthMap, others: Sequence[tuple[Photo, DepthMap]]
) -> list[tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]]:
    """For each other photo, the median of log(photo / other) over the surfaces that both show, and the number of their pixels, by
    channel.
    """
    rows, columns = torch.nonzero(depth.known, as_tuple=True)
    surface = back_project(photo.camera, torch.stack((columns, rows), dim=1) + 0.5, depth.depth[rows, columns])
    colors, ratios = photo.image[rows, columns], []
    for other, other_depth in others:
        pixels, z = project(other.camera, surface)
        x, y = pixels.unbind(1)
        seen = torch.nonzero(inside(x, y, z, other.camera.width, other.camera.height))[:, 0]
        column, row = pixels[seen].long().unbind(1)
        shared = seen[(other_depth.depth[row, column] / z[seen] - 1).abs() <= _TOLERANCE]  # not where it is unknown
        ratios.append(_median_ratio(colors[shared], sample_colors(other, pixels[shared])))
    return ratios


def _median_ratio(
    colors: Float[Tensor, "N 3"], others: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """The median of log(color / other) over those neither dark nor clipped, and their number, by channel."""
    medians, counts = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    low, high = _UNCLIPPED
    for channel, (one, other) in enumerate(zip(colors.T.contiguous(), others.T.contiguous(), strict=True)):
        ratio = (one / other)[(one > low) & (one < high) & (other > low) & (other < high)]
        if len(ratio) >= _FEWEST:
            medians[channel], counts[channel] = ratio.median().double().log(), len(ratio)
    return medians, counts
