"""The grey images that stereo compares, and the depth that it finds of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.view import Photo
from clear_strategies.geometry.projection import intrinsics
from rasterizers.interface import Camera

_ENLARGED: Final = 64_000  # the most pixels of an enlarged photo


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


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The depth of one photo, before it is compared with that of others."""

    image: Grey
    inverse_depth: Float[Tensor, "H W"]  # 1 / z, 1 / world units
    correlation: Float[Tensor, "H W"]  # ZNCC of the windows at that depth, in [-1, 1]


def grey(photo: Photo, enlarge: int, max_pixels: int) -> Grey:
    """The photo's grey image, enlarged, or reduced to at most `max_pixels`."""
    image, camera = photo.image, photo.camera
    reduce = 1
    while (camera.width // reduce) * (camera.height // reduce) > max_pixels:
        reduce += 1
    if reduce > 1:
        image = images.crop_to_multiple(image, reduce)
        camera = replace(camera, width=image.shape[1], height=image.shape[0])
        image, camera = images.downsample(image, reduce, "area"), camera.scaled(1 / reduce)
    elif enlarge > 1 and camera.width * camera.height * enlarge**2 <= min(_ENLARGED, max_pixels):
        image, camera = images.upsample(image, enlarge), camera.scaled(enlarge)
    r, g, b = image.float().unbind(dim=-1)
    return Grey(camera, (r + g + b) / 3)
