"""Cameras that look along z, and photos of simple surfaces, for tests of initial points."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.data.capture import SfmPoints
from rasterizers.interface import Camera


def camera(x: float, width: int = 100, height: int = 100, focal: float = 100.0) -> Camera:
    """At (x, 0, 0), looking along z."""
    pose = torch.eye(4)
    pose[0, 3] = -x
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def photo(x: float = 0.0, size: int = 40) -> Photo:
    """A camera at (x, 0, 0) looking along z with f = 100 px; each pixel has another colour."""
    ramp = torch.linspace(0, 1, size)
    image = torch.stack((ramp.expand(size, size), ramp[:, None].expand(size, size), torch.zeros(size, size)), dim=-1)
    return Photo(camera(x, size, size), image)


def plane_photos(count: int, width: int = 120, height: int = 90) -> list[Photo]:
    """A plane at z = 4: cameras 0.4 apart with f = 100 px see it shifted by whole 10 px."""
    noise = np.random.default_rng(0).random((height, width + 10 * count, 3)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2)
    texture = torch.from_numpy((texture - texture.min()) / np.ptp(texture))
    return [
        Photo(camera(0.4 * i, width, height), texture[:, 10 * i : 10 * i + width].contiguous()) for i in range(count)
    ]


def depth_of(photo: Photo, depth: float | Tensor) -> DepthMap:
    """The same depth at every pixel, or that of each; unknown where it is nan."""
    values = torch.as_tensor(depth).expand(photo.image.shape[:2]).clone()
    return DepthMap(values, values.isfinite().float())


def same_maps(a: Sequence[DepthMap], b: Sequence[DepthMap]) -> bool:
    """Whether depth and confidence have the same bits."""
    return all(
        torch.equal(x.depth.nan_to_num(-1), y.depth.nan_to_num(-1)) and torch.equal(x.confidence, y.confidence)
        for x, y in zip(a, b, strict=True)
    )


def cloud_of(means: Tensor) -> PointCloud:
    return PointCloud(means, torch.rand(len(means), 3, generator=torch.Generator().manual_seed(0)), "test points")


def sfm() -> SfmPoints:
    """Point 0 is observed in frames 1, 2, 3; point 1 in 1 (twice) and 9; point 2 in 2 and 3."""
    observations = [(0, 1), (0, 2), (0, 3), (1, 1), (1, 1), (1, 9), (2, 2), (2, 3)]
    point, image = torch.tensor(observations).T
    return SfmPoints(torch.arange(9.0).view(3, 3), torch.eye(3), point, image, "all of sparse/0")
