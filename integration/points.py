"""A host's initial points: its own, or dense stereo between its training photos."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal

import torch

from clear_strategies.core.points import MAX_POINTS, PointCloud
from clear_strategies.errors import HostError, SettingError
from clear_strategies.geometry import stereo
from clear_strategies.geometry.projection import intrinsics
from integration.views import HostPhoto

_log = logging.getLogger(__name__)

Points = Literal["own", "stereo"]
"""Whose points the Gaussians start from."""


def no_stereo(problem: str) -> HostError:
    """The error of a host whose points cannot be replaced, with the remedy."""
    remedy = "Leave points at own, and write points3D.ply for the host to read: docs/how-to/stereo.md shows how."
    return HostError(f"points=stereo: {problem}. {remedy}")


def wants_stereo(points: str) -> bool:
    """Whether the Gaussians start from stereo, and not from the host's own points.

    Args:
        points: "own" or "stereo".

    Raises:
        SettingError: it is neither.
    """
    if points not in ("own", "stereo"):
        raise SettingError(
            f"points: must be own (the host's) or stereo (dense stereo between its training photos), got {points!r}."
        )
    return points == "stereo"


def stereo_points(photos: Sequence[HostPhoto]) -> PointCloud:
    """Dense stereo between a host's training photos; one line of the log sums them up.

    Args:
        photos: in the host's world. Where the mask is below 0.5 the host hides the pixel, which gets no points. Stereo runs on
            their device.

    Returns:
        At most `MAX_POINTS` points on the CPU: world units, RGB in [0, 1]. More are reduced at random, always to the same.

    Raises:
        DataError: there are fewer than two photos, or stereo confirms no depth.
    """
    posed = [photo.posed for photo in photos]
    dense = stereo(
        [photo.image for photo in posed],
        torch.stack([photo.camera.world_to_camera for photo in posed]) if posed else torch.zeros(0, 4, 4),
        torch.stack([intrinsics(photo.camera) for photo in posed]) if posed else torch.zeros(0, 3, 3),
        masks=[None if photo.mask is None else photo.mask >= 0.5 for photo in photos],
    )
    cloud = PointCloud(dense.means.cpu(), dense.colors.cpu(), dense.summary)
    kept = cloud.at_most(MAX_POINTS)
    chosen = "" if len(kept) == len(cloud) else f"; {len(kept):,} of them, chosen at random, are used"
    _log.info("points=stereo: %s%s.", dense.summary, chosen)
    return kept
