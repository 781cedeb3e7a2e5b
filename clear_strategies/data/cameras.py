"""From the cameras of files to the pinholes of this library: poses checked, sizes matched, lenses straightened.

Every reader ends here. A `Lens` is what files describe: a pinhole, perhaps bent by OpenCV's polynomials, for images of
some size. `posed_photo` fits it to the image that is there, undistorts on loading, and gives a `Frame`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.capture import Frame
from clear_strategies.data.photo_files import image_size, read_image
from clear_strategies.errors import DataError
from rasterizers.interface import Camera

Color = tuple[float, float, float]

_ROTATION_TOLERANCE: Final = 1e-3  # what text files with six digits keep, and no scaled or mirrored frame does
_BORDER_SAMPLES: Final = 33


@dataclass(frozen=True, slots=True)
class Lens:
    """How a camera bends rays onto a `width` × `height` image; pixel (0, 0) has its centre at (0.5, 0.5).

    Args:
        fx, fy, cx, cy: px.
        distortion: OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6), or (k1, k2, k3, k4) of its fisheye; empty: a pinhole.
        fisheye: which of the two.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @property
    def straight(self) -> bool:
        """Nothing to undistort. A fisheye bends even when its coefficients are 0."""
        return not self.fisheye and not any(self.distortion)

    def checked(self, file: Path, field: str) -> Lens:
        """The lens itself, if a camera can have it.

        Raises:
            DataError: a number is not finite, or lies where no camera's does.
        """
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        remedy = "check the calibration"
        if not all(map(math.isfinite, numbers)):
            raise DataError(file, field, f"has a number that is not finite: {numbers}", remedy)
        if not (0 < self.width <= 1_000_000 and 0 < self.height <= 1_000_000):
            raise DataError(file, field, f"has an image size of {self.width}x{self.height} pixels", remedy)
        if not all(1e-3 <= f / self.width <= 1e6 for f in (self.fx, self.fy)):
            raise DataError(
                file, field, f"has focal lengths {self.fx:g}, {self.fy:g} px for {self.width} px of width", remedy
            )
        if not (-self.width <= self.cx <= 2 * self.width and -self.height <= self.cy <= 2 * self.height):
            raise DataError(
                file, field, f"has its principal point ({self.cx:g}, {self.cy:g}) px far outside the image", remedy
            )
        return self

    def resized(self, width: int, height: int, file: Path) -> Lens:
        """The same lens for an image scaled to another size, each axis by its own factor.

        Raises:
            DataError: one factor, up to a pixel of rounding, does not explain both sizes: `file` is another image.
        """
        low = max((width - 1) / self.width, (height - 1) / self.height)
        high = min((width + 1) / self.width, (height + 1) / self.height)
        if low > high:
            raise DataError(
                file,
                "size",
                f"is {width}x{height}, which is no scaled {self.width}x{self.height} as its camera has it",
                "use the images that the cameras were made for, scaled but not cropped",
            )
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )

    def pinhole(self, file: Path) -> Lens:
        """The pinhole an undistorted image has: same size, zoomed until no pixel lacks data.

        Raises:
            DataError: the distortion folds the image over itself, so that no such pinhole exists.
        """
        if self.straight:
            return replace(self, distortion=())
        pinhole = _largest_pinhole(self)
        if pinhole is None:
            raise DataError(
                file,
                "distortion",
                f"{self.distortion} cannot be undistorted over a whole {self.width}x{self.height} image",
                "check the calibration, or undistort the images first (e.g. with `colmap image_undistorter`)",
            )
        return pinhole

    def undistort(self, image: Float[Tensor, "H W 3"], pinhole: Lens) -> Float[Tensor, "H W 3"]:
        """The picture `pinhole` would have taken; bicubic, in [0, 1]."""
        import cv2

        x, y = _sampling_maps(self, pinhole)
        straightened = cv2.remap(image.numpy(), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(straightened).clamp(0, 1)

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K in OpenCV's pixel convention: the first pixel's centre lies at (0, 0)."""
        return np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1]])

    def _with_matrix(self, K: Float[np.ndarray, "3 3"]) -> Lens:
        fx, fy, cx, cy = (float(x) for x in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
        return Lens(self.width, self.height, fx, fy, cx, cy)


def world_to_camera(file: Path, field: str, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[Tensor, "4 4"]:
    """Invert a rigid pose in OpenCV axes; the rotation is replaced by the nearest exact one.

    Raises:
        DataError: not finite, the last row is not (0, 0, 0, 1), or the upper left is no rotation (within 1e-3).
    """
    remedy = "export camera-to-world matrices that are rotations and translations"
    if not np.isfinite(camera_to_world).all():
        raise DataError(file, field, "has a number that is not finite", remedy)
    if not np.array_equal(camera_to_world[3], [0, 0, 0, 1]):
        raise DataError(file, field, f"has the last row {camera_to_world[3].tolist()}, not 0 0 0 1", remedy)
    rotation, center = camera_to_world[:3, :3], camera_to_world[:3, 3]
    if np.abs(rotation).max() > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE:
        raise DataError(file, field, "is no rotation: its rows are not orthonormal within 1e-3", remedy)
    if np.linalg.det(rotation) < 0:
        raise DataError(file, field, "mirrors the world (determinant -1)", remedy)
    left, _, right = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = (left @ right).T
    pose[:3, 3] = -pose[:3, :3] @ center
    return torch.from_numpy(pose)


def posed_photo(
    name: str,
    path: Path,
    lens: Lens,
    pose: Float[Tensor, "4 4"],
    *,
    background: Color | None = None,
    split: str | None = None,
    sfm_id: int | None = None,
) -> Frame:
    """A photo and its camera; only the image's header is read now.

    Args:
        lens: of an image of any size; fitted to the size that `path` has.
        pose: world to camera, OpenCV axes.

    Raises:
        DataError: the image is not there or not usable, or its size is not the lens's, scaled.
    """
    lens = lens.resized(*image_size(path), file=path)
    pinhole = lens.pinhole(path)
    camera = Camera(pose, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, pinhole.width, pinhole.height)
    return Frame(name, camera, partial(_load, path, lens, pinhole, background), split, sfm_id)


def lens_notes(lenses: list[Lens], frames: list[Frame]) -> dict[str, str]:
    """What became of the lenses on the way to the frames, for the printed plan."""
    notes = {}
    pairs = list(zip(lenses, frames, strict=True))
    scaled = [(a, b.camera) for a, b in pairs if (a.width, a.height) != (b.camera.width, b.camera.height)]
    if scaled:
        lens, camera = scaled[0]
        notes["intrinsics"] = (
            f"{len(scaled)} of {len(frames)} cameras rescaled to their images, "
            f"e.g. {lens.width}x{lens.height} to {camera.width}x{camera.height}: "
            f"x {camera.width / lens.width:.5g}, y {camera.height / lens.height:.5g}"
        )
    bent = [(a, b.camera) for a, b in pairs if not a.straight]
    if bent:
        lens, camera = bent[0]
        notes["undistortion"] = (
            f"{len(bent)} of {len(frames)} photos undistorted on loading (OpenCV, bicubic, no borders), "
            f"e.g. fx {lens.fx * camera.width / lens.width:.5g} to {camera.fx:.5g} px"
        )
    return notes


def _load(path: Path, lens: Lens, pinhole: Lens, background: Color | None) -> Float[Tensor, "H W 3"]:
    image = read_image(path, background=background, expect=(lens.width, lens.height))
    return image if lens.straight else lens.undistort(image, pinhole)


@lru_cache(maxsize=64)  # the frames of a capture share few lenses
def _largest_pinhole(lens: Lens) -> Lens | None:
    import cv2

    size, K, bend = (lens.width, lens.height), lens.matrix(), np.array(lens.distortion)
    try:
        if lens.fisheye:
            new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, bend, size, np.eye(3), balance=0.0)
        else:
            new, _ = cv2.getOptimalNewCameraMatrix(K, bend, size, alpha=0)
    except cv2.error:
        return None
    pinhole = lens._with_matrix(new)
    sane = all(map(math.isfinite, (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)))
    if not (sane and all(0.1 < a / b < 10 for a, b in ((pinhole.fx, lens.fx), (pinhole.fy, lens.fy)))):
        return None
    return pinhole if _covers(lens, pinhole) else None


def _covers(lens: Lens, pinhole: Lens) -> bool:
    """Whether the border of the new image comes from inside the old one, up to OpenCV's approximation of it."""
    import cv2

    along = np.linspace(0, 1, _BORDER_SAMPLES)
    border = np.concatenate([np.stack(np.broadcast_arrays(*side), 1) for side in _sides(along)])
    rays = (border * [lens.width, lens.height] - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    bend = np.array(lens.distortion)
    if lens.fisheye:
        pixels = cv2.fisheye.distortPoints(rays[:, None], lens.matrix(), bend)[:, 0]
    else:
        homogeneous = np.column_stack((rays, np.ones(len(rays))))
        pixels = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), lens.matrix(), bend)[0][:, 0]
    slack = 1 + 0.01 * max(lens.width, lens.height)
    inside = (pixels >= -slack) & (pixels <= np.array([lens.width, lens.height]) + slack)
    return bool(inside.all())


def _sides(along: Float[np.ndarray, " n"]) -> list[tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]]:
    zero, one = np.zeros(1), np.ones(1)
    return [(along, zero), (along, one), (zero, along), (one, along)]


@lru_cache(maxsize=1)
def _sampling_maps(lens: Lens, pinhole: Lens) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Where in the distorted image each pixel of the new one lies."""
    import cv2

    maps = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    size, bend = (lens.width, lens.height), np.array(lens.distortion)
    x, y = maps(lens.matrix(), bend, np.eye(3), pinhole.matrix(), size, cv2.CV_32FC1)
    return x, y
