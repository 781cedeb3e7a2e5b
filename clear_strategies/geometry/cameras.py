"""The region that several cameras look at, the choice of cameras to compare, and cameras beside a camera."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import Photo
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_PARTNERS: Final = 12  # photos that a photo is compared with
_NEAREST: Final = 8  # nearest photos among them
_BLURRED: Final = 3e-4  # rounding of positions over the cameras' radius, from which an HR pixel visibly moves
_ALONG: Final = 0.3  # factor of movements along the viewing direction, since moving closer leaves holes


def centers_of(cameras: Sequence[Camera]) -> Float[Tensor, "C 3"]:
    """The positions of the cameras, float64 on the CPU."""
    return torch.stack([camera.center.double().cpu() for camera in cameras])


def warn_if_far(centers: Float[Tensor, "C 3"]) -> None:
    """Warn if float32 cannot resolve positions near the cameras to a fraction of a pixel, as with geographic coordinates."""
    middle = centers.mean(0)
    apart, away = float((centers - middle).norm(dim=1).max()), float(middle.norm())
    rounded = away * torch.finfo(torch.float32).eps / 2
    if rounded > _BLURRED * apart > 0:
        _log.warning(
            "the cameras lie within %.3g units of their mean but %.3g from the origin, where float32 rounds positions to %.2g: "
            "stereo and training lose detail. Subtract the same point from all camera centres and points of the capture.",
            apart, away, rounded,
        )  # fmt: skip


def common_box(photos: Sequence[Photo]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """(smallest, largest corner) of the cube around the largest ball at `looked_at` that all cameras see whole."""
    cameras = [photo.camera for photo in photos]
    middle, centers = looked_at(cameras), centers_of(cameras)
    distance = float(torch.linalg.vector_norm(centers - middle, dim=-1).mean())
    narrowest = min(math.atan(min(c.width / c.fx, c.height / c.fy) / 2) for c in cameras)
    half = distance * math.sin(narrowest)  # the ball touches the sides of the narrowest frustum
    return (middle - half).float(), (middle + half).float()


def looked_at(cameras: Sequence[Camera]) -> Float[Tensor, " 3"]:
    """The point closest to all optical axes, float64. If these are nearly parallel, it lies ahead of the cameras, at ten times
    their largest distance from their mean.
    """
    centers = centers_of(cameras)
    axes = torch.stack([c.world_to_camera[2, :3].double().cpu() for c in cameras])
    extent = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()) or 1.0
    ahead = centers.mean(0) + axes.mean(0) * 10 * extent

    # Least squares over lines, Σ (I - d dᵀ)(x - c) = 0, with a weak pull to `ahead` in case they are parallel.
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    pull = 1e-3 * len(cameras)
    right = (across @ centers[:, :, None]).sum(0)[:, 0] + pull * ahead
    point: Tensor = torch.linalg.solve(across.sum(0) + pull * torch.eye(3, dtype=torch.float64), right)
    return point


def partners(cameras: Sequence[Camera]) -> list[list[int]]:
    """Choose for each camera the others to compare its photo with: all if there are few, else the nearest ones and some at
    increasing distances.

    The nearest alone may be a burst, without parallax, or show only one side of the scene.
    """
    centers, others = centers_of(cameras), len(cameras) - 1
    far = np.geomspace(_NEAREST + 1, max(others, _PARTNERS), _PARTNERS - _NEAREST).round().astype(int) - 1
    ranks = range(others) if others <= _PARTNERS else [*range(_NEAREST), *far]
    ordered = torch.cdist(centers, centers).argsort(dim=1, stable=True).tolist()
    rows = ([b for b in row if b != a] for a, row in enumerate(ordered))
    return [sorted(row[rank] for rank in ranks) for row in rows]


def moved_aside(camera: Camera, distance: float, reach: float, generator: torch.Generator) -> Camera:
    """Move the camera at random by up to `reach` × `distance`, and turn it so that the point at `distance` on its axis stays in
    the middle.
    """
    direction = torch.randn(3, generator=generator, dtype=torch.float64)
    length = torch.rand((), generator=generator, dtype=torch.float64)
    direction = direction / torch.linalg.vector_norm(direction) * length
    direction[2] *= _ALONG
    pose = camera.world_to_camera.double()
    axes, centre = pose[:3, :3], camera.center.double()
    target = centre + axes[2] * distance
    centre = centre + axes.T @ (direction * reach * distance)
    z = F.normalize(target - centre, dim=0)
    x = F.normalize(torch.linalg.cross(axes[1], z), dim=0)
    axes = torch.stack((x, torch.linalg.cross(z, x), z))
    turned = torch.eye(4, dtype=torch.float64)
    turned[:3, :3], turned[:3, 3] = axes, -axes @ centre
    return replace(camera, world_to_camera=turned.to(camera.world_to_camera))


def beside(camera: Camera, means: Float[Tensor, "N 3"], reach: float, generator: torch.Generator) -> Camera:
    """Move the camera aside, see `moved_aside`, with its distance to the median of the points, or 1 if that is 0."""
    distance = torch.linalg.vector_norm(camera.center.double() - means.median(dim=0).values.cpu().double())
    return moved_aside(camera, float(distance) or 1.0, reach, generator)
