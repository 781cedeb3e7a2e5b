"""The grey images that stereo compares, and the cost volume: the dissimilarity of photos at each pixel and depth plane."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.view import Photo
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.kernels import native
from rasterizers.interface import Camera
from rasterizers.native import threads

_VARIANCE_FLOOR: Final = 1e-5  # of grey in [0, 1]: windows with less contrast than noise correlate with nothing
_BLOCK: Final = 1 << 19  # pixels times planes that are compared at once
_ENLARGED: Final = 64_000  # largest number of pixels of an enlarged photo


@dataclass(frozen=True, slots=True, eq=False)
class Grey:
    """A grey image in [0, 1] and the camera on its pixel grid."""

    camera: Camera
    image: Float[Tensor, "H W"]

    def towards(self, other: Grey) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, " 3"]]:
        """(K' R K⁻¹ x of each pixel x, K' t), where (R, t) leads from this camera to the other, K' is the other's.

        A pixel at inverse depth d lies at (u, v) = (X, Y) / Z of the other image with (X, Y, Z) = K' R K⁻¹ x + d K' t, and
        Z / d is its depth there.
        """
        mine, theirs = (c.world_to_camera.double().cpu() for c in (self.camera, other.camera))
        R = theirs[:3, :3] @ mine[:3, :3].T
        t = theirs[:3, 3] - R @ mine[:3, 3]
        K, K_other = (intrinsics(c) for c in (self.camera, other.camera))
        H, shift = K_other @ R @ torch.linalg.inv(K), K_other @ t
        x = (torch.arange(self.camera.width, dtype=torch.float64) + 0.5)[None, :, None]
        y = (torch.arange(self.camera.height, dtype=torch.float64) + 0.5)[:, None, None]
        return (x * H[:, 0] + y * H[:, 1] + H[:, 2]).to(self.image), shift.to(self.image)


def grey(photo: Photo, enlarge: int, max_pixels: int) -> Grey:
    """The grey image of a photo, enlarged by `enlarge` if it is small, or reduced to at most `max_pixels`."""
    reduce = photo.factor_to(max_pixels)
    whole = photo.cropped(reduce)
    image, camera = images.downsample(whole.image, reduce, "area"), whole.camera.scaled(1 / reduce)
    if reduce == 1 and enlarge > 1 and camera.width * camera.height * enlarge**2 <= min(_ENLARGED, max_pixels):
        image, camera = images.upsample(image, enlarge), camera.scaled(enlarge)
    r, g, b = image.float().unbind(dim=-1)
    return Grey(camera, (r + g + b) / 3)


def cost_volume(
    photo: Grey, others: Sequence[Grey], inverse_depths: Float[Tensor, " D"], window: int
) -> Float[Tensor, "H W D"]:
    """(1 - ZNCC) / 2 in [0, 1], the mean over the better half of the other photos: the worse half may be occluded.

    ZNCC is the correlation of two windows, E[(a - E a)(b - E b)] / (σ_a σ_b), of the photo and of the other photo drawn
    through the plane; a plane that a photo does not see costs as unrelated windows do, 0.5.
    """
    height, width = photo.image.shape
    volume = photo.image.new_empty(height, width, len(inverse_depths))
    image = photo.image.contiguous()
    mean, deviation = (moment[0] for moment in _moments(image[None], window))
    swept = []
    for other in others:
        rotated, shift = photo.towards(other)
        swept.append((rotated.permute(2, 0, 1).contiguous(), shift, other.image.contiguous()))
    if native.runs(image):
        native.module().cost_volume(
            image, mean, deviation, swept, inverse_depths, window, _VARIANCE_FLOOR, volume, threads()
        )  # fmt: skip
        return volume

    def cost(other: tuple[Tensor, Tensor, Tensor], planes: slice) -> Float[Tensor, "P H W"]:
        """From the correlation with the windows of the other photo warped by each plane; unseen ones correlate with 0."""
        drawn, seen = _warped(*other, inverse_depths[planes])
        mean_drawn, deviation_drawn = _moments(drawn, window)
        covariance = box_mean(image * drawn, window) - mean * mean_drawn
        correlation = torch.where(seen, covariance, 0.0) / (deviation_drawn * deviation)
        return (1 - correlation) / 2

    at_once = max(1, _BLOCK // (height * width))
    for first in range(0, len(inverse_depths), at_once):
        planes = slice(first, first + at_once)
        costs = (cost(other, planes) for other in swept)
        volume[:, :, planes] = mean_of_lowest(costs, (len(others) + 1) // 2).permute(1, 2, 0)
    return volume


def mean_of_lowest(values: Iterator[Tensor], count: int) -> Tensor:
    """The mean of the `count` lowest, element by element; only `count` tensors are kept."""
    lowest: list[Tensor] = []
    for value in values:
        rest = value
        for k, kept in enumerate(lowest):
            lowest[k], rest = torch.minimum(kept, rest), torch.maximum(kept, rest)
        if len(lowest) < count:
            lowest.append(rest)
    mean: Tensor = functools.reduce(torch.add, lowest) / count
    return mean


def _warped(
    rotated: Float[Tensor, "3 H W"],
    shift: Float[Tensor, " 3"],
    image: Float[Tensor, "h w"],
    planes: Float[Tensor, " P"],
) -> tuple[Float[Tensor, "P H W"], Bool[Tensor, "P H W"]]:
    """(another photo's image, warped by each plane, True where the pixel lies inside it).

    A pixel's point at inverse depth d projects to K' (R K⁻¹ x + d t), up to its third coordinate, see `Grey.towards`.
    """
    x, y, z = (rotated[k] + shift[k] * planes[:, None, None] for k in range(3))
    height, width = image.shape
    # grid_sample's coordinates: -1 and 1 are the outer borders of the image.
    u, v = x.div_(z * (width / 2)).sub_(1), y.div_(z * (height / 2)).sub_(1)
    seen = (z > 0) & (torch.maximum(u.abs(), v.abs()) < 1)
    grid = torch.view_as_real(torch.complex(u, v))  # a stack in a tenth of the time
    images = image.expand(len(planes), 1, height, width)
    drawn = torch.nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)
    return drawn[:, 0], seen


def _moments(images: Float[Tensor, "P H W"], window: int) -> tuple[Float[Tensor, "P H W"], Float[Tensor, "P H W"]]:
    """(mean, standard deviation) of each pixel's window."""
    mean = box_mean(images, window)
    variance = box_mean(images * images, window) - mean * mean
    return mean, (variance.clamp_min(0) + _VARIANCE_FLOOR).sqrt()


def box_mean(images: Float[Tensor, "P H W"], window: int) -> Float[Tensor, "P H W"]:
    """The mean over square windows; the border is repeated. Sums have a fixed order."""
    radius = window // 2
    padded = torch.nn.functional.pad(images, (radius,) * 4, mode="replicate")
    height, width = images.shape[1:]
    rows = padded[:, :height].clone()
    for k in range(1, window):
        rows += padded[:, k : k + height]
    total = rows[:, :, :width].clone()
    for k in range(1, window):
        total += rows[:, :, k : k + width]
    return total.mul_(1 / window**2)
