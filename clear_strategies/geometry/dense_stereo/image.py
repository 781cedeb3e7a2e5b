"""The grey images that stereo compares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.projection import towards
from clear_strategies.core.view import Photo
from rasterizers.interface import Camera

_ENLARGED: Final = 64_000  # the most pixels of an enlarged photo


@dataclass(frozen=True, slots=True, eq=False)
class Grey:
    """A grey image in [0, 1] and the camera on its pixel grid."""

    camera: Camera
    image: Float[Tensor, "H W"]

    def towards(self, other: Grey) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, " 3"]]:
        """(K' R K⁻¹ x of each pixel x, K' t), where (R, t) leads from this camera to the other, K' is the other's."""
        rotated, shift = towards(self.camera, other.camera)
        return rotated.to(self.image), shift.to(self.image)


def grey(photo: Photo, enlarge: int, max_pixels: int) -> Grey:
    """The photo's grey image, enlarged, or reduced to at most `max_pixels`."""
    image, camera = photo.image, photo.camera
    reduce = 1
    while (camera.width // reduce) * (camera.height // reduce) > max_pixels:
        reduce += 1
    if reduce > 1:
        image = images.crop_to_multiple(image, reduce)
        camera = Camera(
            camera.world_to_camera, camera.fx, camera.fy, camera.cx, camera.cy, image.shape[1], image.shape[0]
        )
        image, camera = images.downsample(image, reduce, "area"), camera.scaled(1 / reduce)
    elif enlarge > 1 and camera.width * camera.height * enlarge**2 <= min(_ENLARGED, max_pixels):
        image, camera = images.upsample(image, enlarge), camera.scaled(enlarge)
    r, g, b = image.float().unbind(dim=-1)
    return Grey(camera, (r + g + b) / 3)
