"""Random points, for scenes without other points."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import Photo
from clear_strategies.geometry.cameras import common_box


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
