"""From points to pixels and back, which cameras see a point, and an image's colours there. Pixel (0, 0) spans [0, 1)²."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.view import Photo
from rasterizers.interface import Camera, Color
from rasterizers.native import kernel_threads, threads

T = TypeVar("T")

_AT_ONCE: Final = 4  # photos that are worked on at the same time, at most
_BEHIND: Final = 0.03  # a camera sees a point whose depth there exceeds the camera's own by at most this share of it
_SAME_COLOR: Final = 2 / 255  # largest difference of a background pixel from the background's colour


def each_photo(work: Callable[[int], T], photos: Sequence[Photo]) -> Iterator[T]:
    """work(0), work(1), … in order, for each photo; on the CPU of several at once: much of such work, as a path through an image,
    has no use for a second thread, and torch's threads wait for each other by spinning. No more than `_AT_ONCE`, for the memory.
    """
    n, count = threads(), len(photos)
    if any(photo.image.device.type != "cpu" for photo in photos):
        yield from map(work, range(count))
        return
    at_once = max(1, min(n, count, _AT_ONCE))
    with kernel_threads(n // at_once), ThreadPoolExecutor(at_once) as pool:
        yield from pool.map(work, range(count))


def intrinsics(camera: Camera) -> Float[Tensor, "3 3"]:
    """K, float64 on the CPU."""
    return torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=torch.float64)


def projection_matrix(camera: Camera) -> Float[Tensor, "3 4"]:
    """K [R | t], float64 on the CPU."""
    return intrinsics(camera) @ camera.world_to_camera.double().cpu()[:3]


def project(camera: Camera, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 2"], Float[Tensor, " N"]]:
    """(pixels, depths in world units), float64; pixels are meaningful where depth > 0."""
    matrix = projection_matrix(camera)
    homogeneous = points.double() @ matrix[:, :3].T + matrix[:, 3]
    return homogeneous[:, :2] / homogeneous[:, 2:], homogeneous[:, 2]


def inside_of(camera: Camera, pixels: Float[Tensor, "N 2"], depth: Float[Tensor, " N"]) -> Bool[Tensor, " N"]:
    """Whether points that project to these pixels, at these depths, lie in the camera's image."""
    x, y = pixels.unbind(dim=1)  # by column: `all` along rows of two takes twice as long
    return (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)


def seen_pixels(
    camera: Camera, points: Float[Tensor, "N 3"]
) -> tuple[Bool[Tensor, " N"], Int[Tensor, " M"], Int[Tensor, " M"], Float[Tensor, " M"]]:
    """Which points project into the image, and the rows, columns and depths of these M points."""
    pixels, depth = project(camera, points)
    inside = inside_of(camera, pixels, depth)
    column, row = pixels[inside].long().unbind(dim=1)
    return inside, row, column, depth[inside]


def times_seen(
    points: Float[Tensor, "N 3"], cameras: Sequence[tuple[Camera, Float[Tensor, "h w"]]]
) -> Int[Tensor, " N"]:
    """In how many cameras, each with its depth (nan without a surface), each point is inside the image and not hidden."""
    count = torch.zeros(len(points), dtype=torch.long)
    for camera, depth in cameras:
        inside, row, column, z = seen_pixels(camera, points)
        count[inside] += z <= depth[row, column] * (1 + _BEHIND)
    return count


def on_surface(
    camera: Camera, depth: Float[Tensor, "h w"], points: Float[Tensor, "N 3"], tolerance: float
) -> tuple[Bool[Tensor, " N"], Float[Tensor, "N 2"]]:
    """(whether each point's depth differs from `depth`, nan or 0 where it is unknown, by at most `tolerance`, relatively; the
    pixels that the points project to).
    """
    pixels, z = project(camera, points)
    inside = inside_of(camera, pixels, z)
    column, row = torch.where(inside[:, None], pixels, 0.0).long().unbind(dim=1)
    return inside & ((depth[row, column] / z - 1).abs() <= tolerance), pixels


def back_project(camera: Camera, pixels: Float[Tensor, "G 2"], depth: Float[Tensor, " G"]) -> Float[Tensor, "G 3"]:
    """The points at these depths (z, world units) behind these pixels."""
    pose = camera.world_to_camera.double().cpu()
    x = (pixels[:, 0] - camera.cx) / camera.fx * depth
    y = (pixels[:, 1] - camera.cy) / camera.fy * depth
    return ((torch.stack((x, y, depth), dim=1) - pose[:3, 3]) @ pose[:3, :3]).float()


def ray_angles(a: Float[Tensor, " 3"], b: Float[Tensor, "*K 3"], points: Float[Tensor, "N 3"]) -> Float[Tensor, "*K N"]:
    """Angles at these points between the rays from camera centres a and b, degrees; all in float64."""
    y = points - b[..., None, :]
    x = (points - a).expand_as(y)
    sine = torch.linalg.vector_norm(torch.linalg.cross(x, y), dim=-1)
    # Not from the cosine alone: that of a small angle rounds to 1.
    return torch.rad2deg(torch.atan2(sine, (x * y).sum(-1)))


def sample_colors(image: Float[Tensor, "H W 3"], pixels: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Bilinear samples; outside the centres of the border pixels, the border's colour."""
    height, width = image.shape[:2]
    grid = (2 * pixels / torch.tensor([width, height]) - 1).to(image)[None, None]
    batch = image.permute(2, 0, 1)[None]
    samples = torch.nn.functional.grid_sample(batch, grid, padding_mode="border", align_corners=False)
    return samples[0, :, 0].T.cpu()


def blackened(photo: Photo) -> Photo:
    """The photo with black in place of what its mask hides, where no features are found then."""
    return photo if photo.shown is None else replace(photo, image=photo.image * photo.shown[..., None])


def is_background(colors: Float[Tensor, "*shape 3"], background: Color) -> Bool[Tensor, "*shape"]:
    """Whether colours are that of the background, up to rounding, so that no surface is there."""
    return ((colors - torch.tensor(background).to(colors)).abs() <= _SAME_COLOR).all(dim=-1)
