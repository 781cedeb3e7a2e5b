"""Lenses and poses as the readers find them, and the pinhole cameras they become."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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

_LARGEST_SIDE: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics in pixels of a width × height image whose first pixel is centred at (0.5, 0.5).

    Args:
        distortion: OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6), or (k1, k2, k3, k4) with `fisheye`; empty: a pinhole.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    def check(self, file: Path, where: str) -> Lens:
        """Itself.

        Raises:
            DataError: a number is not finite, a focal length or size not positive.
        """
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(math.isfinite(x) and abs(x) < 1e12 for x in numbers):
            raise DataError(file, where, f"has intrinsics that are not finite: {numbers}", "estimate the cameras again")
        if not (self.fx > 0 and self.fy > 0):
            problem = f"has focal lengths {self.fx:g}, {self.fy:g}; they must be > 0"
            raise DataError(file, where, problem, "check the camera")
        if not (0 < self.width < _LARGEST_SIDE and 0 < self.height < _LARGEST_SIDE):
            raise DataError(file, where, f"has size {self.width}x{self.height}", "check the camera")
        return self

    @property
    def distorts(self) -> bool:
        return self.fisheye or any(k != 0 for k in self.distortion)

    def resized(self, width: int, height: int) -> Lens:
        """The same lens on another pixel grid, each axis by its own factor."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def undistorted(self) -> Lens:
        """The pinhole whose whole image is filled once distortion is removed, at the same size."""
        if not self.distorts:
            return replace(self, distortion=())
        import cv2

        size, coefficients = (self.width, self.height), np.array(self.distortion, float)
        if self.fisheye:
            K = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                self._matrix(), coefficients, size, np.eye(3), balance=0
            )
        else:
            K, _ = cv2.getOptimalNewCameraMatrix(self._matrix(), coefficients, size, 0)
        return Lens(self.width, self.height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5)

    def undistort(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """The image that `undistorted` sees."""
        if not self.distorts:
            return image
        import cv2

        target, size, coefficients = self.undistorted(), (self.width, self.height), np.array(self.distortion, float)
        init = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        maps = init(self._matrix(), coefficients, np.eye(3), target._matrix(), size, cv2.CV_32FC1)
        result = cv2.remap(image.numpy(), maps[0], maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(result).clamp(0, 1)

    def _matrix(self) -> np.ndarray:
        """OpenCV's: its first pixel is centred at (0, 0)."""
        return np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1.0]])


def make_frame(
    name: str,
    image: Path,
    lens: Lens,
    pose: Float[Tensor, "4 4"],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    split: str | None = None,
    sfm_id: int | None = None,
) -> Frame:
    """A frame whose lens is fitted to the image's real size and whose image is undistorted when it is loaded.

    Raises:
        DataError: the image is not there, or its shape is not the lens's.
    """
    width, height = image_size(image)
    if abs(width / height - lens.width / lens.height) > 0.02 * width / height:
        raise DataError(
            image, "size", f"is {width}x{height}, but its camera is for {lens.width}x{lens.height}: another shape",
            "use the images that the cameras were estimated from, or a scaled copy of them",
        )  # fmt: skip
    fitted = lens.resized(width, height)
    pinhole = fitted.undistorted()
    camera = Camera(pose, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, width, height)

    def load() -> Float[Tensor, "H W 3"]:
        return fitted.undistort(read_image(image, background=background, expect=(width, height)))

    return Frame(name, camera, load, split=split, sfm_id=sfm_id)


def pose_from_opengl(file: Path, where: str, matrix: object) -> Float[Tensor, "4 4"]:
    """World-to-camera (OpenCV axes) from a camera-to-world matrix with OpenGL axes (x right, y up, z back).

    Raises:
        DataError: not a rigid 3x4 or 4x4 matrix of finite numbers.
    """
    remedy = "write camera-to-world matrices: a rotation, a translation, last row 0 0 0 1"
    rows = matrix if isinstance(matrix, list) else []
    if len(rows) not in (3, 4) or not all(_is_row(row) for row in rows):
        raise DataError(file, where, "is no 3x4 or 4x4 matrix of finite numbers", remedy)
    full = np.eye(4)
    full[: len(rows)] = np.array(rows, float)
    if np.abs(full[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DataError(file, where, f"has the last row {full[3].tolist()}", remedy)
    rotation = full[:3, :3] * np.array([1.0, -1.0, -1.0])  # OpenGL's y and z point the other way
    return rigid_inverse(file, where, rotation, full[:3, 3])


def rigid_inverse(file: Path, where: str, rotation: np.ndarray, center: np.ndarray) -> Float[Tensor, "4 4"]:
    """World-to-camera from a camera's axes (columns) and centre.

    Raises:
        DataError: the axes are not orthonormal and right-handed within 1e-3.
    """
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or abs(np.linalg.det(rotation) - 1) > 1e-3:
        raise DataError(
            file, where, f"holds no rotation (determinant {np.linalg.det(rotation):.4g})",
            "remove scale and reflection from the camera-to-world matrices",
        )  # fmt: skip
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ center
    return torch.from_numpy(pose)


def by_name(frames: Sequence[Frame], file: Path) -> tuple[Frame, ...]:
    """Frames in order of names.

    Raises:
        DataError: two have the same name, or there is none.
    """
    if not frames:
        raise DataError(file, "frames", "there is none", "give a capture with at least one posed photo")
    ordered = tuple(sorted(frames, key=lambda f: f.name))
    for frame, following in itertools.pairwise(ordered):
        if frame.name == following.name:
            raise DataError(file, "file name", f"{frame.name!r} belongs to two frames", "give each photo one pose")
    return ordered


def _is_row(row: object) -> bool:
    return isinstance(row, list) and len(row) == 4 and all(_is_number(x) for x in row)


def _is_number(x: object) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e18
