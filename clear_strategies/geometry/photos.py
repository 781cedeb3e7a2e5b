"""Photos as a user or another trainer gives them, checked; their pixels that show no surface, because of a mask or a plain
background; and parallel work on several photos.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.finite import is_finite
from clear_strategies.core.view import Photo
from clear_strategies.errors import DataError
from rasterizers.interface import Camera, Color
from rasterizers.native import kernel_threads, threads

T = TypeVar("T")

_AT_ONCE: Final = 4  # largest number of photos that are processed at the same time, to bound memory
_SAME_COLOR: Final = 2 / 255  # largest difference of a background pixel from the background's colour
_CUT_OUT: Final = 0.25  # share of background pixels from which the photos show an object cut out of its surroundings


def require_shape(of: str, field: str, x: Tensor, shape: Sequence[int], remedy: str) -> None:
    """Raise a DataError unless the tensor has this shape."""
    if x.shape != tuple(shape):
        raise DataError(of, field, f"must have shape {[*shape]}, got {[*x.shape]}", remedy)


def require_range(of: str, field: str, values: Tensor, *, overshoot: float = 0.0) -> None:
    """Raise a DataError unless all values are finite and, but for `overshoot`, in [0, 1]."""
    if not is_finite(values):
        bad = int((~torch.isfinite(values)).sum())
        raise DataError(of, field, f"has {bad:,} numbers that are not finite", "give numbers in [0, 1]")
    low, high = (float(x) for x in values.aminmax())
    if low < -overshoot or high > 1 + overshoot:
        problem = f"must lie in [0, 1], has values from {low:.3g} to {high:.3g}"
        raise DataError(of, field, problem, "divide 8-bit values by 255, or clamp")


def image_of(
    of: str, field: str, image: Tensor, *, alpha: bool = False, overshoot: float = 0.0
) -> Float[Tensor, "h w 3"]:
    """RGB as float32 from floating point in [0, 1], up to `overshoot`, or from 8 bits.

    Args:
        alpha: there may be a fourth channel, which is left out.
    """
    if image.ndim != 3 or image.shape[-1] not in ((3, 4) if alpha else (3,)) or not image.numel():
        remedy = "put the RGB channels last" if alpha else "put the RGB channels last, without alpha"
        raise DataError(of, field, f"must have shape [h, w, 3], got {[*image.shape]}", remedy)
    rgb = image.detach()[..., :3]
    if image.dtype == torch.uint8:
        return rgb.float() / 255
    if not image.is_floating_point():
        problem = f"must be uint8 or floating point, got {image.dtype}"
        raise DataError(of, field, problem, "give uint8 in 0…255, or float in [0, 1]")
    require_range(of, field, rgb, overshoot=overshoot)
    return rgb.float()


def camera_of(of: str, pose: tuple[str, Tensor], K: tuple[str, Tensor], image: Float[Tensor, "h w 3"]) -> Camera:
    """The camera of an image, on the CPU, from pose and camera matrix, each with its name."""
    require_shape(of, *pose, (4, 4), "add the last row 0 0 0 1 to rotation and translation")
    require_shape(of, *K, (3, 3), "give the camera matrix of this photo alone")
    (fx, skew, cx), (below, fy, cy), last = K[1].tolist()
    if not skew == below == 0 or last != [0, 0, 1]:
        problem = f"must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K[1].tolist()}"
        raise DataError(of, K[0], problem, "rectify the photo")
    try:
        return Camera(pose[1].detach().cpu(), fx, fy, cx, cy, image.shape[1], image.shape[0])
    except ValueError as error:
        remedy = "give OpenCV's rigid world-to-camera, and K in pixels"
        raise DataError(of, f"{pose[0]} and {K[0]}", str(error), remedy) from error


def blackened(photo: Photo) -> Photo:
    """Paint the hidden pixels of a photo black, so that no features are found there."""
    return photo if photo.shown is None else replace(photo, image=photo.image * photo.shown[..., None])


def is_background(colors: Float[Tensor, "*shape 3"], background: Color) -> Bool[Tensor, "*shape"]:
    """True where colours are that of the background, up to rounding, so that there is no surface."""
    return ((colors - torch.tensor(background).to(colors)).abs() <= _SAME_COLOR).all(dim=-1)


def cut_out(photos: Iterable[Photo], background: Color) -> bool:
    """Return True if the photos show an object cut out of its surroundings: a quarter of them is the background's colour."""
    shares = [float(is_background(photo.image, background).float().mean()) for photo in photos]
    return bool(shares) and sum(shares) / len(shares) >= _CUT_OUT


def each_photo(work: Callable[[int], T], photos: Sequence[Photo]) -> Iterator[T]:
    """Yield work(0), work(1), … in order, one for each photo; on the CPU several are computed at once, because much of such work
    is sequential within a photo, as paths through an image are, and torch's threads wait for each other by spinning.
    """
    n, count = threads(), len(photos)
    if any(photo.image.device.type != "cpu" for photo in photos):
        yield from map(work, range(count))
        return
    at_once = max(1, min(n, count, _AT_ONCE))
    with kernel_threads(n // at_once), ThreadPoolExecutor(at_once) as pool:
        yield from pool.map(work, range(count))
