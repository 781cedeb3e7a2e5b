"""Points from the training LR images alone, under their known poses: no test view and no HR pixel has a part in them.

SIFT finds features, each pair of views matches them both ways, the known epipolar geometry throws out what cannot be
the same point, and what is triangulated must lie in front of both cameras, reproject closely, and be seen under an angle.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.view import Photo, PointCloud
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TriangulationSettings:
    """What counts as the same point.

    Args:
        enlarge: images are enlarged this often before features are sought; small images have few otherwise.
        contrast: SIFT's contrast threshold; lower finds more and weaker features.
        ratio: a match must be this much closer than the second best (Lowe).
        epipolar: largest distance from the epipolar line, LR px. reprojection: largest error, LR px.
        angle: smallest angle between the two rays, degrees.
    """

    enlarge: int = 2
    contrast: float = 0.01
    ratio: float = 0.85
    epipolar: float = 1.0
    reprojection: float = 1.0
    angle: float = 1.0

    def __post_init__(self) -> None:
        if self.enlarge < 1:
            raise ValueError(f"enlarge must be at least 1, got {self.enlarge}.")
        for name in ("contrast", "epipolar", "reprojection", "angle"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be > 0, got {getattr(self, name)}.")
        if not 0 < self.ratio <= 1:
            raise ValueError(f"ratio must lie in (0, 1], got {self.ratio}.")


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Keypoints of one image, in its own pixels, with their descriptors."""

    pixels: Float[np.ndarray, "F 2"]
    descriptors: Float[np.ndarray, "F 128"]


def triangulate(photos: Sequence[Photo], settings: TriangulationSettings | None = None) -> PointCloud:
    """A cloud from every pair of photos; empty where nothing matches."""
    settings = settings or TriangulationSettings()
    features = [find_features(photo, settings) for photo in photos]
    means, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for i, j in itertools.combinations(range(len(photos)), 2):
        first, second = match(features[i], features[j], settings.ratio)
        if len(first):
            points, kept = triangulate_pair(photos[i].camera, photos[j].camera, first, second, settings)
            means.append(points.float())
            colors.append(_colors_at(photos[i].image, first[kept.numpy()]))
            _log.info("views %d and %d: %d matches, %d points.", i, j, len(first), len(points))
    cloud = torch.cat(means)
    source = f"{len(cloud):,} points triangulated from the {len(photos)} training LR images"
    return PointCloud(cloud, torch.cat(colors), source, saw_test_views="no")


def find_features(photo: Photo, settings: TriangulationSettings) -> Features:
    """SIFT keypoints and RootSIFT descriptors of the enlarged image."""
    import cv2

    pixels = (photo.image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    size = (grey.shape[1] * settings.enlarge, grey.shape[0] * settings.enlarge)
    large = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)
    sift = cv2.SIFT_create(contrastThreshold=settings.contrast)  # type: ignore[attr-defined]
    found, descriptors = sift.detectAndCompute(large, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # OpenCV's pixel (0, 0) has its centre at (0, 0), ours at (0.5, 0.5).
    points = (np.array([k.pt for k in found]) + 0.5) / settings.enlarge
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12))
    return Features(points, root.astype(np.float32))


def match(a: Features, b: Features, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the features that are each other's best match, clearly better than their second best."""
    import cv2

    if len(a.pixels) < 2 or len(b.pixels) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(b.descriptors, a.descriptors)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in matcher.knnMatch(a.descriptors, b.descriptors, k=2)
        if best.distance < ratio * second.distance and back.get(best.trainIdx) == best.queryIdx
    ]
    index = np.array(pairs, np.int64).reshape(-1, 2)
    return a.pixels[index[:, 0]], b.pixels[index[:, 1]]


def triangulate_pair(
    a: Camera, b: Camera, first: np.ndarray, second: np.ndarray, settings: TriangulationSettings
) -> tuple[Float[Tensor, "P 3"], Tensor]:
    """World points, and which of the matches they come from."""
    from kornia.geometry import epipolar

    x, y = torch.from_numpy(first).double()[None], torch.from_numpy(second).double()[None]
    P, Q = _projection(a)[None], _projection(b)[None]
    F = epipolar.fundamental_from_projections(P[:, :3], Q[:, :3])
    distance = epipolar.symmetrical_epipolar_distance(x, y, F, squared=False)[0] / 2**0.5
    points = epipolar.triangulate_points(P[:, :3], Q[:, :3], x, y)[0]

    in_front = (_depth(a, points) > 0) & (_depth(b, points) > 0)
    error = torch.maximum(_reprojection_error(P[0], points, x[0]), _reprojection_error(Q[0], points, y[0]))
    ray_a, ray_b = points - a.center.double(), points - b.center.double()
    angle = torch.rad2deg(torch.arccos(torch.cosine_similarity(ray_a, ray_b, dim=-1).clamp(-1, 1)))
    good = in_front & (distance <= settings.epipolar) & (error <= settings.reprojection) & (angle >= settings.angle)
    kept = torch.nonzero(good & points.isfinite().all(-1))[:, 0]
    return points[kept], kept


def _projection(camera: Camera) -> Float[Tensor, "3 4"]:
    K = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]], dtype=torch.float64)
    return K @ camera.world_to_camera.double()[:3]


def _depth(camera: Camera, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    pose = camera.world_to_camera.double()
    return points @ pose[2, :3] + pose[2, 3]


def _reprojection_error(P: Float[Tensor, "3 4"], points: Float[Tensor, "P 3"], pixels: Tensor) -> Float[Tensor, " P"]:
    projected = points @ P[:, :3].T + P[:, 3]
    error: Tensor = torch.linalg.vector_norm(projected[:, :2] / projected[:, 2:] - pixels, dim=-1)
    return error


def _colors_at(image: Float[Tensor, "H W 3"], pixels: np.ndarray) -> Float[Tensor, "P 3"]:
    height, width = image.shape[:2]
    x = torch.from_numpy(pixels[:, 0]).long().clamp(0, width - 1)
    y = torch.from_numpy(pixels[:, 1]).long().clamp(0, height - 1)
    return image[y, x]
