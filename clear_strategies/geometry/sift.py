"""Triangulation of SIFT matches between photos with known poses.

SIFT features are matched between `partners`, in both directions. A match is rejected if it violates the epipolar geometry of the
poses, or if its triangulated point lies behind a camera, has too large a reprojection error, or too small an angle between its
rays. Matches that share features form a track, which is one point; the pair with the widest angle gives its position.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.images import to_bytes
from clear_strategies.core.points import PointCloud
from clear_strategies.core.progress import told
from clear_strategies.core.view import Photo
from clear_strategies.geometry.cameras import partners
from clear_strategies.geometry.optional import REMEDY, missing
from clear_strategies.geometry.projection import project, projection_matrix, ray_angles, sample_colors
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_ROWS: Final = 512  # features matched at a time, so that their distances stay in the cache


@dataclass(frozen=True, slots=True)
class TriangulationSettings:
    """Settings of SIFT, and of the acceptance of matches.

    Args:
        enlarge: factor by which images are enlarged before SIFT runs; small images give few features otherwise.
        contrast: SIFT's contrast threshold; a lower one gives more and weaker features.
        max_features: number of strongest features of an image; the time of matching grows with its square. None: all.
        ratio: largest distance of a match, relative to that of the second best (Lowe's ratio test).
        epipolar: largest distance from the epipolar lines, root mean square over both views, LR px.
        reprojection: largest reprojection error in either view, LR px.
        angle: smallest angle between the two rays, degrees.

    Raises:
        SettingError: a number is outside its range.
    """

    enlarge: int = 2
    contrast: float = 0.01
    max_features: int | None = 8192
    ratio: float = 0.85
    epipolar: float = 1.0
    reprojection: float = 1.0
    angle: float = 1.0

    def __post_init__(self) -> None:
        require_whole("enlarge", self.enlarge, least=1)
        if self.max_features is not None:
            require_whole("max_features", self.max_features, least=1)
        require_number("ratio", self.ratio, above=0, most=1)
        for name in ("contrast", "epipolar", "reprojection", "angle"):
            require_number(name, getattr(self, name), above=0)


class Features(NamedTuple):
    """Keypoints of one image, in its own pixels, and their descriptors of length 1."""

    pixels: Float[Tensor, "F 2"]
    descriptors: Float[Tensor, "F 128"]


class Pairs(NamedTuple):
    """Triangulated points of pairs of views: position, the two features (numbered over all views), angle between the rays
    (degrees).
    """

    means: Float[Tensor, "P 3"]
    features: Int[Tensor, "P 2"]
    angles: Float[Tensor, " P"]


def features_of(photos: Sequence[Photo]) -> PointCloud:
    """The points of `triangulate`; empty without OpenCV, kornia or SciPy, with a note in the log and the cloud's `source`."""
    if packages := missing("cv2", "kornia", "scipy"):
        _log.warning("no features are triangulated without %s: %s", packages, REMEDY)
        return PointCloud(torch.zeros(0, 3), torch.zeros(0, 3), f"no triangulated features without {packages}")
    return triangulate(photos)


def triangulate(photos: Sequence[Photo], settings: TriangulationSettings | None = None) -> PointCloud:
    """Triangulate the features that at least two photos have in common; an empty cloud if nothing matches."""
    settings = settings or TriangulationSettings()
    features = [find_features(photo, settings) for photo in photos]
    view = torch.repeat_interleave(torch.arange(len(photos)), torch.tensor([len(f.pixels) for f in features]))
    first_of = torch.searchsorted(view, torch.arange(len(photos)))
    per_pair = [Pairs(torch.zeros(0, 3).double(), torch.zeros(0, 2, dtype=torch.long), torch.zeros(0).double())]
    compared = enumerate(partners([photo.camera for photo in photos]))
    pairs_of_views = sorted({(min(i, j), max(i, j)) for i, others in compared for j in others})
    for i, j in told(pairs_of_views, "features that photos have in common", "pairs", len(pairs_of_views)):
        index = match(features[i], features[j], settings.ratio)
        x, y = features[i].pixels[index[:, 0]], features[j].pixels[index[:, 1]]
        points, angles, good = triangulate_pair(photos[i].camera, photos[j].camera, x, y, settings)
        per_pair.append(Pairs(points[good], index[good] + first_of[[i, j]], angles[good]))
    pairs = Pairs(*map(torch.cat, zip(*per_pair, strict=True)))
    chosen = one_per_track(pairs, view)

    sampled = [sample_colors(photo, f.pixels) for photo, f in zip(photos, features, strict=True)]
    colors = torch.cat(sampled)[pairs.features[chosen]].mean(dim=1) if len(chosen) else torch.zeros(0, 3)
    source = f"{len(chosen):,} points triangulated from the {len(photos)} photos"
    return PointCloud(pairs.means[chosen].float(), colors, source)


def find_features(photo: Photo, settings: TriangulationSettings) -> Features:
    """Find SIFT keypoints in the enlarged image, with RootSIFT descriptors: square roots of the L1-normalized ones."""
    import cv2

    grey = cv2.cvtColor(to_bytes(photo.image), cv2.COLOR_RGB2GRAY)
    size = (grey.shape[1] * settings.enlarge, grey.shape[0] * settings.enlarge)
    large = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)
    # Without the precise upscale every keypoint is a quarter of a pixel too far right and down.
    sift: Any = cv2.SIFT_create(  # type: ignore[attr-defined]
        nfeatures=settings.max_features or 0, contrastThreshold=settings.contrast, enable_precise_upscale=True
    )
    keypoints, descriptors = sift.detectAndCompute(large, None)
    if descriptors is None:
        return Features(torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 128))
    # OpenCV's first pixel is centred at (0, 0), ours at (0.5, 0.5).
    points = (np.array([k.pt for k in keypoints], np.float64) + 0.5) / settings.enlarge
    relative = torch.nn.functional.normalize(torch.from_numpy(descriptors), p=1, dim=1)
    return Features(torch.from_numpy(points), relative.sqrt())


def match(a: Features, b: Features, ratio: float) -> Int[Tensor, "M 2"]:
    """Match features: indices of mutual nearest neighbours that pass Lowe's ratio test against the second nearest in b."""
    if len(a.pixels) < 1 or len(b.pixels) < 2:
        return torch.zeros(0, 2, dtype=torch.long)
    nearest = [(rows @ b.descriptors.T).topk(2, dim=1) for rows in torch.split(a.descriptors, _ROWS)]
    similarity, candidate = map(torch.cat, zip(*nearest, strict=True))
    distance = (2 - 2 * similarity).clamp_min(0).sqrt()  # |x - y|² = 2 - 2 x·y: descriptors have length 1
    first = torch.nonzero(distance[:, 0] < ratio * distance[:, 1])[:, 0]
    second = candidate[first, 0]
    mutual = (b.descriptors[second] @ a.descriptors.T).argmax(dim=1) == first
    return torch.stack((first[mutual], second[mutual]), dim=1)


def triangulate_pair(
    a: Camera, b: Camera, x: Float[Tensor, "M 2"], y: Float[Tensor, "M 2"], settings: TriangulationSettings
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, " M"], Bool[Tensor, " M"]]:
    """Triangulate the rays through pixels x of a and y of b: (point, angle in degrees, accepted)."""
    from kornia.geometry import epipolar

    if len(x) == 0:  # kornia refuses empty batches
        return x.new_zeros(0, 3), x.new_zeros(0), torch.zeros(0, dtype=torch.bool)
    P, Q = projection_matrix(a)[None], projection_matrix(b)[None]
    F = epipolar.fundamental_from_projections(P, Q)
    squares: Tensor = epipolar.symmetrical_epipolar_distance(x[None], y[None], F)[0]
    points: Tensor = epipolar.triangulate_points(P, Q, x[None], y[None])[0]

    (u, depth_a), (v, depth_b) = project(a, points), project(b, points)
    error = torch.maximum(torch.linalg.vector_norm(u - x, dim=-1), torch.linalg.vector_norm(v - y, dim=-1))
    angle = ray_angles(a.center.double(), b.center.double(), points)
    good = points.isfinite().all(-1) & (depth_a > 0) & (depth_b > 0)
    good &= (squares / 2).sqrt() <= settings.epipolar
    good &= (error <= settings.reprojection) & (angle >= settings.angle)
    return points, angle, good


def one_per_track(pairs: Pairs, view: Int[Tensor, " F"]) -> Int[Tensor, " T"]:
    """Choose the pair with the widest angle of each track. A track with two features of one view is contradictory and dropped."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b = pairs.features.numpy().T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(view), len(view)))
    count, track = connected_components(graph, directed=False)
    views_of_tracks = np.unique(np.stack((track, view.numpy())), axis=1)[0]  # each track once per view
    contradictory = np.bincount(track, minlength=count) != np.bincount(views_of_tracks, minlength=count)
    order = np.argsort(-pairs.angles.numpy(), kind="stable")
    tracks, widest = np.unique(track[a[order]], return_index=True)
    return torch.from_numpy(order[widest[~contradictory[tracks]]])
