"""With which photos a photo is compared, and at which depths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import Photo
from clear_strategies.geometry.cameras import common_box
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.projection import back_project, inside_of, project, ray_angles, seen_pixels
from rasterizers.interface import Camera

_FEW: Final = 20  # points in a photo, below which a grid at guessed depths replaces them
_SAMPLED: Final = 1000  # points in a photo, at most, by which the others are scored
_ANGLES: Final = (1.0, 5.0, 20.0, 45.0)  # degrees between rays: useless, best from, best to, too different to compare
_LEAST_SCORE: Final = 0.05
_QUANTILES: Final = (0.02, 0.98)
_FARTHER, _NEARER = 0.5, 1.4  # the range of inverse depth is wider than that of the points by these factors
_GUESS_FAR, _GUESS_NEAR = 0.1, 3.0  # the same, about the depth of what all cameras look at


@dataclass(frozen=True, slots=True)
class Comparison:
    """What one photo is compared with.

    Args:
        others: indices of photos, best first.
        far, near: the smallest and largest inverse depth, 1 / world units.
    """

    others: tuple[int, ...]
    far: float
    near: float


def comparisons(photos: Sequence[Photo], points: Float[Tensor, "N 3"]) -> list[Comparison]:
    """For each photo, the others that see the same surfaces at a useful angle, and the range of depth.

    Args:
        points: of the surfaces, world units; where a photo sees few, depths are guessed from the cameras.
    """
    cameras = [photo.camera for photo in photos]
    low, high = common_box(photos)
    middle = (low + high)[None] / 2
    compared = []
    for i, camera in enumerate(cameras):
        inside, _, _, depth = seen_pixels(camera, points)
        if len(depth) >= _FEW:
            seen = points[inside].double()[:: math.ceil(len(depth) / _SAMPLED)]
            far, near = torch.quantile(1 / depth, torch.tensor(_QUANTILES, dtype=depth.dtype)).tolist()
            far, near = _FARTHER * far, _NEARER * near
        else:
            distance = float(project(camera, middle)[1][0])
            distance = distance if distance > 0 else float(torch.linalg.vector_norm(middle - camera.center))
            seen, far, near = _grid(camera, distance), _GUESS_FAR / distance, _GUESS_NEAR / distance
        scores = {j: _score(camera, other, seen) for j, other in enumerate(cameras) if j != i}
        others = sorted((j for j in scores if scores[j] >= _LEAST_SCORE), key=lambda j: (-scores[j], j))
        compared.append(Comparison(tuple(others), far, near))
    return compared


def plane_count(camera: Camera, others: Sequence[Camera], comparison: Comparison, settings: StereoSettings) -> int:
    """Planes, uniform in inverse depth, of which neighbours lie at most `plane_step` px apart in the other photos."""
    paths = []
    for other in others:
        ends = [project(other, _grid(camera, 1 / inverse)) for inverse in (comparison.far, comparison.near)]
        ahead = (ends[0][1] > 0) & (ends[1][1] > 0)
        shift = torch.linalg.vector_norm(ends[0][0] - ends[1][0], dim=1)[ahead]
        if len(shift):
            paths.append(float(shift.median()))
    return max(8, min(settings.max_planes, math.ceil(max(paths, default=0.0) / settings.plane_step) + 1))


def _grid(camera: Camera, distance: float) -> Float[Tensor, "36 3"]:
    """Points at one depth behind 6 by 6 pixels."""
    x, y = ((torch.arange(6, dtype=torch.float64) + 0.5) / 6 * size for size in (camera.width, camera.height))
    return back_project(camera, torch.cartesian_prod(x, y), torch.full((36,), distance, dtype=torch.float64)).double()


def _score(camera: Camera, other: Camera, points: Float[Tensor, "M 3"]) -> float:
    """The share of the points that both see, each weighted by how well its angle and its scales suit a comparison."""
    pixels, depth = project(other, points)
    inside = inside_of(other, pixels, depth)
    angle = ray_angles(camera, other, points)
    none, best, until, different = _ANGLES
    suits = torch.minimum((angle - none) / (best - none), (different - angle) / (different - until)).clamp(0, 1)
    scale = (project(camera, points)[1] / camera.fx) / (depth / other.fx)  # of the same surface in the two photos
    suits = suits * torch.minimum(scale, 1 / scale).clamp(0, 1)
    return float(torch.where(inside, suits, 0.0).mean())
