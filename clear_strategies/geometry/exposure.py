"""Equalization of exposure and white balance: a gain per photo and channel, from the colours of surfaces that photos share.

A camera that chooses its exposure for each photo multiplies linear light, and so does white balance. Where the sRGB curve is
close to a power, the photo is multiplied by a power of the same number: one gain per channel describes both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.cameras import partners
from clear_strategies.geometry.projection import back_project, project, sample_colors, seen_pixels

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
    pairs = [(a, b) for a, others in enumerate(partners([photo.camera for photo in photos])) for b in others]
    if not pairs:
        return torch.ones(len(photos), 3, device=device)
    photos, depths = [photo.to("cpu") for photo in photos], [depth.to("cpu") for depth in depths]
    measured = (_ratio(photos[a], depths[a], photos[b], depths[b]) for a, b in pairs)
    ratios, weights = map(torch.stack, zip(*measured, strict=True))  # [pairs, 3]
    difference = torch.zeros(len(pairs), len(photos), dtype=torch.float64)
    for row, (a, b) in enumerate(pairs):
        difference[row, a], difference[row, b] = 1, -1
    root = weights.sqrt()
    # The pseudo-inverse has the least norm: the mean of the logarithms, which no pair determines, is 0.
    logs = [torch.linalg.pinv(root[:, c, None] * difference) @ (root[:, c] * ratios[:, c]) for c in range(3)]
    return torch.exp(-torch.stack(logs, dim=1)).float().to(device)


def _ratio(photo: Photo, depth: DepthMap, other: Photo, other_depth: DepthMap) -> tuple[Tensor, Tensor]:
    """The median of log(photo / other) over the surfaces that both show, and the number of their pixels, by channel."""
    rows, columns = torch.nonzero(depth.known, as_tuple=True)
    surface = back_project(photo.camera, torch.stack((columns, rows), dim=1) + 0.5, depth.depth[rows, columns])
    shared, row, column, z = seen_pixels(other.camera, surface)
    shared[shared.clone()] = (other_depth.depth[row, column] / z - 1).abs() <= _TOLERANCE  # False where it is unknown
    pixels = project(other.camera, surface)[0][shared]
    colors, other_colors = photo.image[rows[shared], columns[shared]], sample_colors(other, pixels)
    low, high = _UNCLIPPED
    usable = (colors > low) & (colors < high) & (other_colors > low) & (other_colors < high)
    medians, counts = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for channel in range(3):
        log = (colors / other_colors).double().log()[usable[:, channel], channel]
        if len(log) >= _FEWEST:
            medians[channel], counts[channel] = log.median(), len(log)
    return medians, counts
