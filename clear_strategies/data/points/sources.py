"""Points that exist already, of a PLY file or the scene's structure from motion (SfM), and random ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import Photo
from clear_strategies.data.capture import SfmPoints
from clear_strategies.data.ply import read_points
from clear_strategies.errors import DataError
from clear_strategies.geometry.cameras import common_box


def from_ply(path: Path) -> PointCloud:
    """The points of a PLY file."""
    cloud = read_points(path)
    if len(cloud) == 0:
        raise DataError(path, "element vertex", "has no points", "give another file, or use another init")
    return cloud


def from_sfm(sfm: SfmPoints) -> PointCloud:
    """All of the scene's SfM points. They were triangulated from all views, test views included."""
    return PointCloud(sfm.means.float(), sfm.colors.float(), sfm.source, uses_test_views="yes")


def from_tracks(sfm: SfmPoints, train_ids: Sequence[int], min_views: int) -> PointCloud:
    """The scene's SfM points that at least `min_views` of the frames `train_ids` observe.

    Their positions still come from all views, test views included, so `uses_test_views` is "yes".

    Raises:
        DataError: there is no such point, or the points have no tracks.
    """
    if len(sfm.track_point) == 0:
        raise DataError("scene", "points", "come without tracks", "use init=triangulated, or init=sfm for all of them")
    observed = torch.isin(sfm.track_image, torch.tensor(list(train_ids), dtype=sfm.track_image.dtype))
    pairs = torch.unique(torch.stack((sfm.track_point[observed], sfm.track_image[observed]), dim=1), dim=0)
    kept = torch.nonzero(torch.bincount(pairs[:, 0], minlength=len(sfm.means)) >= min_views)[:, 0]
    if len(kept) == 0:
        problem = f"none is observed by {min_views} of the {len(train_ids)} training views"
        raise DataError("scene", "points", problem, "lower min_views, or use init=triangulated")
    source = f"{len(kept):,} points observed by >= {min_views} training views, of {sfm.source}"
    return PointCloud(sfm.means.float(), sfm.colors.float(), source, uses_test_views="yes")[kept]


def random_cloud(photos: Sequence[Photo], count: int, seed: int, box: float | None = None) -> PointCloud:
    """Uniform points in a box, nearly grey.

    Args:
        box: half-edge of the box around the origin, world units; None: `common_box`.
    """
    if box is None:
        (low, high), where = common_box(photos), "the cameras' common box"
    else:
        low, high, where = torch.full((3,), -box), torch.full((3,), box), f"[-{box:g}, {box:g}]³"
    g = torch.Generator().manual_seed(seed)
    means = low + (high - low) * torch.rand(count, 3, generator=g)
    # Equal colours would give all points equal colour gradients.
    colors = 0.5 + (torch.rand(count, 3, generator=g) - 0.5) * 0.1
    return PointCloud(means, colors, f"random: {count:,} points in {where}")
