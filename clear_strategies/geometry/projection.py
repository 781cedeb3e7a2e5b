"""Projection of points to pixels and back, sampling of colours, and slopes of depth. Pixel (0, 0) spans [0, 1)²."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.view import Photo
from rasterizers.interface import Camera

_NO_WEIGHT: Final = 1e-6  # of a pixel in a bilinear mean


def intrinsics(camera: Camera) -> Float[Tensor, "3 3"]:
    """K, float64 on the CPU."""
    K = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    return torch.tensor(K, dtype=torch.float64, device=camera.world_to_camera.device)


def projection_matrix(camera: Camera) -> Float[Tensor, "3 4"]:
    """K [R | t], float64 on the CPU."""
    return intrinsics(camera) @ camera.world_to_camera.double().cpu()[:3]


def project(camera: Camera, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 2"], Float[Tensor, " N"]]:
    """Project points to (pixels, depths in world units), float64; pixels are meaningful where depth > 0."""
    matrix = projection_matrix(camera)
    homogeneous = points.double() @ matrix[:, :3].T + matrix[:, 3]
    return homogeneous[:, :2] / homogeneous[:, 2:], homogeneous[:, 2]


def inside(x: Tensor, y: Tensor, depth: Tensor, width: int | Tensor, height: int | Tensor) -> Bool[Tensor, "*shape"]:
    """True for points that project to these columns x and rows y, at these depths, inside an image of this size."""
    return (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)


def seen_pixels(
    camera: Camera, points: Float[Tensor, "N 3"]
) -> tuple[Bool[Tensor, " N"], Int[Tensor, " M"], Int[Tensor, " M"], Float[Tensor, " M"]]:
    """(mask of the points that project into the image, the rows, columns and depths of these M points)."""
    pixels, depth = project(camera, points)
    seen = inside(pixels[:, 0], pixels[:, 1], depth, camera.width, camera.height)
    column, row = pixels[seen].long().unbind(dim=1)
    return seen, row, column, depth[seen]


def back_project(camera: Camera, pixels: Float[Tensor, "G 2"], depth: Float[Tensor, " G"]) -> Float[Tensor, "G 3"]:
    """The points at these depths (z, world units) on the rays of these pixels (column, row)."""
    pose = camera.world_to_camera.double().cpu()
    x = (pixels[:, 0] - camera.cx) / camera.fx * depth
    y = (pixels[:, 1] - camera.cy) / camera.fy * depth
    return ((torch.stack((x, y, depth), dim=1) - pose[:3, 3]) @ pose[:3, :3]).float()


def ray_angles(a: Float[Tensor, " 3"], b: Float[Tensor, "*K 3"], points: Float[Tensor, "N 3"]) -> Float[Tensor, "*K N"]:
    """Angles at these points between the rays from camera centres a and b, degrees; all in float64."""
    y = points - b[..., None, :]
    x = (points - a).expand_as(y)
    sine = torch.linalg.vector_norm(torch.linalg.cross(x, y), dim=-1)
    # The cosine alone would not do: that of a small angle rounds to 1.
    return torch.rad2deg(torch.atan2(sine, (x * y).sum(-1)))


def sample_colors(photo: Photo, pixels: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Sample bilinearly at pixels (column, row); beyond the centres of the border pixels, the border's colour is returned. Hidden
    pixels are left out of the mean; it is black where all are hidden.
    """
    image = photo.image
    grid = (2 * pixels / torch.tensor([photo.camera.width, photo.camera.height]) - 1).to(image)[None, None]

    def sampled(layer: Float[Tensor, "H W C"]) -> Float[Tensor, "N C"]:
        batch = layer.permute(2, 0, 1)[None]
        samples = torch.nn.functional.grid_sample(batch, grid, padding_mode="border", align_corners=False)
        return samples[0, :, 0].T.cpu()

    if photo.shown is None:
        return sampled(image)
    shown = photo.shown[..., None].to(image)
    return sampled(image * shown) / sampled(shown).clamp_min(_NO_WEIGHT)


def slopes(values: Float[Tensor, "h w"], axis: int) -> Float[Tensor, "h w"]:
    """The smaller of a pixel's differences from its two neighbours along an axis; 0 where their signs differ or one is nan. This
    is exact on planes, and continues no surface across an edge.
    """
    step = values.diff(dim=axis)
    if step.shape[axis] == 0:  # one row or column
        return torch.zeros_like(values)
    before, after = torch.cat((step.narrow(axis, 0, 1), step), axis), torch.cat((step, step.narrow(axis, -1, 1)), axis)
    return torch.where(before * after > 0, torch.where(before.abs() < after.abs(), before, after), 0.0)
