"""The choice of the photos that a photo is compared with, and of the range of depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.view import Photo
from clear_strategies.geometry.cameras import centers_of, looked_at
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.projection import (
    back_project,
    inside,
    project,
    projection_matrix,
    ray_angles,
    seen_pixels,
)
from rasterizers.interface import Camera

_FEW: Final = 20  # points in a photo, below which a grid at guessed depths replaces them
_SAMPLED: Final = 1000  # largest number of points of a photo by which other photos are scored
_CANDIDATES: Final = 4  # candidates per photo to be chosen, which are scored by all these points
_GLANCED: Final = 40  # approximate number of points by which the candidates are chosen
_ANGLES: Final = (1.0, 5.0, 20.0, 45.0)  # degrees between rays: useless, best from, best to, too different to compare
_LEAST_SCORE: Final = 0.05
_QUANTILES: Final = (0.02, 0.98)
_FARTHER, _NEARER = 0.5, 1.4  # the range of inverse depth is wider than that of the points by these factors
_GUESS_FAR, _GUESS_NEAR = 0.1, 3.0  # the same, relative to the depth of the point that all cameras look at


class Comparison(NamedTuple):
    """The photos that a photo is compared with, and the range of depth."""

    others: tuple[int, ...]  # indices of photos, best first
    far: float  # the smallest inverse depth, 1 / world units
    near: float  # the largest


def comparisons(photos: Sequence[Photo], points: Float[Tensor, "N 3"], most: int) -> list[Comparison]:
    """Choose for each photo up to `most` others that see the same surfaces at the best angles, and the range of depth.

    Of more than `_CANDIDATES` × `most` others, that many are first chosen by a few points, then scored by all.

    Args:
        points: of the surfaces, world units; for a photo that sees few, depths are guessed from the cameras.
    """
    middle = looked_at([photo.camera for photo in photos])[None].float()
    cameras = _Cameras([photo.camera for photo in photos])
    compared = []
    for i, photo in enumerate(photos):
        camera = photo.camera
        seen, _, _, depth = seen_pixels(camera, points)
        if len(depth) >= _FEW:
            sampled = points[seen].double()[:: math.ceil(len(depth) / _SAMPLED)]
            far, near = torch.quantile(1 / depth, torch.tensor(_QUANTILES, dtype=depth.dtype)).tolist()
            far, near = _FARTHER * far, _NEARER * near
        else:
            distance = float(project(camera, middle)[1][0])
            distance = distance if distance > 0 else float(torch.linalg.vector_norm(middle - camera.center))
            sampled, far, near = _grid(camera, distance), _GUESS_FAR / distance, _GUESS_NEAR / distance
        others = torch.tensor([j for j in range(len(photos)) if j != i], dtype=torch.long)
        if len(others) > _CANDIDATES * most:
            glance = cameras.scores(i, others, sampled[:: math.ceil(len(sampled) / _GLANCED)])
            others = others[glance.topk(_CANDIDATES * most).indices.sort().values]
        scores = cameras.scores(i, others, sampled)
        best = scores.argsort(descending=True, stable=True)[:most]
        compared.append(Comparison(tuple(others[best[scores[best] >= _LEAST_SCORE]].tolist()), far, near))
    return compared


def plane_count(camera: Camera, others: Sequence[Camera], comparison: Comparison, settings: StereoSettings) -> int:
    """The number of planes, uniform in inverse depth, with neighbours at most `plane_step` px apart in the other photos."""
    paths = []
    for other in others:
        ends = [project(other, _grid(camera, 1 / inverse)) for inverse in (comparison.far, comparison.near)]
        ahead = (ends[0][1] > 0) & (ends[1][1] > 0)
        shift = torch.linalg.vector_norm(ends[0][0] - ends[1][0], dim=1)[ahead]
        if len(shift):
            paths.append(float(shift.median()))
    return max(8, min(settings.max_planes, math.ceil(max(paths, default=0.0) / settings.plane_step) + 1))


def _grid(camera: Camera, distance: float) -> Float[Tensor, "36 3"]:
    """6 by 6 points at one depth."""
    x, y = ((torch.arange(6, dtype=torch.float64) + 0.5) / 6 * size for size in (camera.width, camera.height))
    return back_project(camera, torch.cartesian_prod(x, y), torch.full((36,), distance, dtype=torch.float64)).double()


class _Cameras:
    """Cameras as float64 tensors, to score a photo against many others at once."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self.matrix = torch.stack([projection_matrix(c) for c in cameras])
        self.center = centers_of(cameras)
        self.size = torch.tensor([(c.width, c.height) for c in cameras], dtype=torch.float64)
        self.fx = torch.tensor([c.fx for c in cameras], dtype=torch.float64)

    def scores(self, one: int, others: Int[Tensor, " K"], points: Float[Tensor, "M 3"]) -> Float[Tensor, " K"]:
        """The share of the points that `one` and each other see, weighted by how well their angles and scales suit."""
        x, y, depth = self._projected(others, points).unbind(-1)
        width, height = self.size[others, :, None].unbind(1)
        x, y = x / depth, y / depth
        shown = inside(x, y, depth, width, height)
        angle = ray_angles(self.center[one], self.center[others], points)
        none, best, until, different = _ANGLES
        suits = torch.minimum((angle - none) / (best - none), (different - angle) / (different - until)).clamp(0, 1)
        # The ratio of the surface's size in the two photos.
        scale = (self._projected(one, points)[:, 2] / self.fx[one]) / (depth / self.fx[others, None])
        suits = suits * torch.minimum(scale, 1 / scale).clamp(0, 1)
        return torch.where(shown, suits, 0.0).mean(-1)

    def _projected(self, which: int | Int[Tensor, " K"], points: Float[Tensor, "M 3"]) -> Float[Tensor, "*K M 3"]:
        matrix = self.matrix[which]
        return points @ matrix[..., :3].mT + matrix[..., None, :, 3]
