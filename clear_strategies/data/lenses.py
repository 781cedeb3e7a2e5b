"""Intrinsics with lens distortion, as files give them, and undistortion by OpenCV."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.errors import DataError

FARTHEST: Final = 1e12
"""The largest coordinate, world units: float32 cannot resolve a scene beyond it."""
_LARGEST_SIDE: Final = 1 << 20
_SHORTEST: Final = 0.1  # focal length in sides of the image: a pinhole of 157 degrees, a fisheye of more than 360
_ONE, _TWO = "f cx cy ", "fx fy cx cy "
# COLMAP's camera models in the order of its numbers, with their parameters; p and k are counted from 1 here.
CAMERA_MODELS: Final = {
    "SIMPLE_PINHOLE": _ONE, "PINHOLE": _TWO, "SIMPLE_RADIAL": _ONE + "k1", "RADIAL": _ONE + "k1 k2",
    "OPENCV": _TWO + "k1 k2 p1 p2", "OPENCV_FISHEYE": _TWO + "k1 k2 k3 k4", "FULL_OPENCV": _TWO + "k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": _TWO + "omega", "SIMPLE_RADIAL_FISHEYE": _ONE + "k1", "RADIAL_FISHEYE": _ONE + "k1 k2",
    "THIN_PRISM_FISHEYE": _TWO + "k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": _TWO + "k1 k2 k3 k4 k5 k6 p1 p2 s0 s1 s2 s3", "SIMPLE_DIVISION": _ONE + "k",
    "DIVISION": _TWO + "k", "SIMPLE_FISHEYE": _ONE, "FISHEYE": _TWO, "EUCM": _TWO + "alpha beta", "EQUIRECTANGULAR": "",
}  # fmt: skip
# The coefficients that OpenCV undistorts, in its order; those that a model has beside them must be 0.
_PERSPECTIVE: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE: Final = ("k1", "k2", "k3", "k4")
_UNDISTORT: Final = (
    "with a COLMAP model, colmap image_undistorter --image_path images --input_path sparse/0 --output_path undistorted"
)
CUT: Final = (
    "cut panoramas into flat photos: "
    "ns-process-data images --camera-type equirectangular --data images --output-dir flat"
)
"""The remedy for panoramas of 360 degrees."""
_SAMPLES: Final = 65  # a side
_MOST_ZOOM: Final = 2.0
_ZOOMS: Final = 36
_WIDEST: Final = math.tan(math.radians(70))
"""The tangent of the angle between an undistorted photo's middle and its corners, at most: pixels are then 8 times as long."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics, in pixels of a width × height image whose first pixel is centred at (0.5, 0.5), and lens distortion.

    Args:
        distortion: the first of OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6), or with `fisheye` of (k1, k2, k3, k4); empty: a
            pinhole.
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
    def distorts(self) -> bool:
        return self.fisheye or any(k != 0 for k in self.distortion)

    @property
    def coefficients(self) -> Float[np.ndarray, " k"]:
        """The distortion with zeros appended, since OpenCV needs at least four numbers."""
        return np.array([*self.distortion, *[0.0] * (4 - len(self.distortion))], dtype=np.float64)

    def resized(self, width: int, height: int, file: Path) -> Lens:
        """Rescale the lens to an image of another size, each axis by its own factor.

        Raises:
            DataError: the aspect ratios differ by more than a pixel of the smaller image: `file` is another image.
        """
        if abs(width * self.height - height * self.width) > max(width + height, self.width + self.height):
            problem = f"is {width}x{height}, but its camera is for {self.width}x{self.height}: another shape"
            remedy = "use the images that the cameras were estimated from, or a scaled copy of them"
            raise DataError(file, "size", problem, remedy)
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def undistorted(self, file: Path) -> Lens:
        """Return the pinhole of the undistorted image, of the same size and zoomed so that every pixel has data.

        Raises:
            DataError: there is none, because the distortion folds the image over itself.
        """
        pinhole = _filled_pinhole(self) if self.distorts else replace(self, distortion=())
        if pinhole is None:
            problem = f"{self.distortion} cannot be removed from a {self.width}x{self.height} image"
            raise DataError(
                file, "distortion", problem, f"check the camera, or undistort the images first; {_UNDISTORT}"
            )
        return pinhole

    def undistort(self, image: Float[Tensor, "H W *C"], pinhole: Lens) -> Float[Tensor, "H W *C"]:
        """Resample the image for `pinhole`, bicubically; the result lies in [0, 1]."""
        import cv2

        x, y = _sampling_maps(self, pinhole)
        result = cv2.remap(image.numpy(), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(result).clamp(0, 1)

    def sampled(self, values: Float[np.ndarray, "H W"], pinhole: Lens) -> Float[np.ndarray, "h w"]:
        """The nearest of the values at each pixel of `pinhole`, which may have another size, float32."""
        import cv2

        x, y = _sampling_maps(self, pinhole)
        return cv2.remap(values.astype(np.float32), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K in OpenCV's convention: the first pixel is centred at (0, 0)."""
        return np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1.0]])


def lens_of(
    file: Path,
    where: str,
    model: str,
    size: tuple[int, int],
    pinhole: tuple[float, float, float, float],
    terms: Mapping[str, float],
) -> Lens:
    """Make the lens of a camera model by name.

    Args:
        pinhole: fx, fy, cx, cy.
        terms: distortion coefficients by their names, p and k counted from 1; those left out are 0.

    Raises:
        DataError: OpenCV cannot undistort the lens, or its intrinsics are not plausible.
    """
    kept = terms_of(file, where, model)
    if rest := [name for name, value in terms.items() if value != 0 and name not in kept]:
        problem = f"has {rest[0]} = {terms[rest[0]]:g}; of the camera model {model} it must be 0"
        raise DataError(file, where, problem, f"check the model, or undistort the photos first; {_UNDISTORT}")
    lens = Lens(*size, *pinhole, tuple(terms.get(name, 0.0) for name in kept), "FISHEYE" in model)
    (width, height), (fx, fy, cx, cy) = size, pinhole
    if not all(abs(x) < FARTHEST for x in (*pinhole, *lens.distortion)):  # not for nan
        problem = f"has intrinsics that are not finite: {(*pinhole, *lens.distortion)}"
        raise DataError(file, where, problem, "estimate the cameras again")
    if not (0 < width < _LARGEST_SIDE and 0 < height < _LARGEST_SIDE):
        raise DataError(file, where, f"has size {width}x{height}", "check the camera")
    shortest = min(fx / width, fy / height)
    in_sides = 0 < max(cx, cy) <= 1 < min(width, height) / 8  # units of the image's sides in place of pixels
    if not (shortest > _SHORTEST and max(fx, fy) / width < 1e6) or in_sides:
        lengths = f"focal lengths {fx:g}, {fy:g} and principal point ({cx:g}, {cy:g})"
        remedy = "multiply what is in units of the image by its width (x) and height (y)"
        problem = f"has {lengths} where the image is {width}x{height}; all must be pixels"
        raise DataError(file, where, problem, remedy if shortest > 0 else "estimate the cameras again")
    if not (-width < cx < 2 * width and -height < cy < 2 * height):
        raise DataError(
            file, where, f"has its principal point ({cx:g}, {cy:g}) px far outside the image", "check the camera"
        )
    return lens


def terms_of(file: Path, where: str, model: str) -> tuple[str, ...]:
    """Return the coefficients of a camera model that need not be 0; a DataError if the model is not supported."""
    if parameters := CAMERA_MODELS.get(model, "").split():
        extra = ["k3"] if model == "OPENCV" else []  # nerfstudio adds k3, and a k4 that is not OpenCV's
        return tuple(k for k in (_FISHEYE if "FISHEYE" in model else _PERSPECTIVE) if k in [*parameters, *extra])
    remedy = CUT if model == "EQUIRECTANGULAR" else f"undistort the photos first; {_UNDISTORT}"
    raise DataError(file, where, f"has the camera model {model[:40]}, which is not supported", remedy)


@lru_cache(maxsize=64)  # a capture has few lenses
def _filled_pinhole(lens: Lens) -> Lens | None:
    """Return OpenCV's pinhole, or one around the lens's own middle, zoomed until it is filled; None if neither is."""
    first = math.hypot(lens.width / lens.fx, lens.height / lens.fy) / 2 / _WIDEST  # a zoom of the lens
    around = replace(lens, distortion=(), fisheye=False)
    candidates = [(around, np.geomspace(first, _MOST_ZOOM, _ZOOMS))] if first < _MOST_ZOOM else []
    # OpenCV returns K itself, or a view that is too wide, if it cannot invert the lens up to the corners.
    if (pinhole := _opencv_pinhole(lens)) is not None:
        candidates.insert(0, (pinhole, np.geomspace(1.0, _MOST_ZOOM, _ZOOMS)))
    zoomed = (
        replace(pinhole, fx=zoom * pinhole.fx, fy=zoom * pinhole.fy)
        for pinhole, zooms in candidates
        for zoom in zooms.tolist()
    )
    return next((pinhole for pinhole in zoomed if _covers(lens, pinhole)), None)


def _opencv_pinhole(lens: Lens) -> Lens | None:
    """Return the pinhole that OpenCV chooses; None if it finds none that is plausible."""
    import cv2

    size, K, coefficients = (lens.width, lens.height), lens.matrix(), lens.coefficients
    try:
        if lens.fisheye:
            new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, coefficients, size, np.eye(3), balance=0.0)
        else:
            new, _ = cv2.getOptimalNewCameraMatrix(K, coefficients, size, alpha=0)
    except cv2.error:
        return None
    fx, fy, cx, cy = (float(x) for x in (new[0, 0], new[1, 1], new[0, 2] + 0.5, new[1, 2] + 0.5))
    if not (all(map(math.isfinite, (cx, cy))) and 0.1 < fx / lens.fx < 10 and 0.1 < fy / lens.fy < 10):
        return None
    pinhole = Lens(*size, fx, fy, cx, cy)
    return pinhole if math.hypot(size[0] / fx, size[1] / fy) / 2 <= _WIDEST else None


def _covers(lens: Lens, pinhole: Lens) -> bool:
    """Return True if the undistorted image lies inside the distorted one, up to OpenCV's approximation, and is not folded."""
    import cv2

    t = np.linspace(0, 1, _SAMPLES)
    grid = np.stack(np.meshgrid(t, t), axis=-1)  # row, column, (x, y)
    rays = (grid * [lens.width, lens.height] - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    if lens.fisheye:
        pixels = cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), lens.matrix(), lens.coefficients)
    else:
        homogeneous = np.concatenate((rays, np.ones_like(rays[..., :1])), axis=-1).reshape(-1, 3)
        pixels, _ = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), lens.matrix(), lens.coefficients)
    pixels = pixels.reshape(grid.shape)
    right, down = np.diff(pixels, axis=1)[:-1], np.diff(pixels, axis=0)[:, :-1]
    unfolded = right[..., 0] * down[..., 1] > right[..., 1] * down[..., 0]
    slack = 1 + 0.01 * max(lens.width, lens.height)
    inside = (pixels >= -slack) & (pixels <= np.array([lens.width, lens.height]) + slack)
    return bool(unfolded.all() and inside.all())


@lru_cache(maxsize=1)
def _sampling_maps(lens: Lens, pinhole: Lens) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """The position of each pixel of `pinhole` in the distorted image."""
    import cv2

    maps, size = (cv2.fisheye if lens.fisheye else cv2).initUndistortRectifyMap, (pinhole.width, pinhole.height)
    x, y = maps(lens.matrix(), lens.coefficients, np.eye(3), pinhole.matrix(), size, cv2.CV_32FC1)
    return x, y


def forget_maps() -> None:
    """Free the sampling maps that `Lens.undistort` caches, 8 bytes per pixel."""
    _sampling_maps.cache_clear()
