"""Pixels of photos that show no surface, because of a mask or a plain background; and parallel work on several photos."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.view import Photo
from rasterizers.interface import Color
from rasterizers.native import kernel_threads, threads

T = TypeVar("T")

_AT_ONCE: Final = 4  # largest number of photos that are processed at the same time, to bound memory
_SAME_COLOR: Final = 2 / 255  # largest difference of a background pixel from the background's colour
_CUT_OUT: Final = 0.25  # share of background pixels from which the photos show an object cut out of its surroundings


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
