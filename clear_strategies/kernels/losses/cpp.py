"""The losses of `reference` in C++, for float32 images [H, W, 3] on the CPU.

SSIM is accurate in float32 because sums are taken about a value inside each window (`kernels/src/ssim.hpp`). Results have
the same bits for any number of threads.

Every loss raises `BackendUnavailable` if the kernels were not compiled, `TypeError` for images that are not float32 on the
CPU, and `ValueError` for sizes that do not match.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses.images import ImagePair, image_pair
from clear_strategies.kernels.losses.reference import LossAndGradient
from rasterizers.interface import BackendUnavailable
from rasterizers.native import load_kernels, threads

DEVICES: Final = ("cpu",)


def available() -> bool:
    """Whether the kernels were compiled and run on this processor."""
    try:
        native()
    except BackendUnavailable:
        return False
    return True


@cache
def native() -> ModuleType:
    """The compiled module for this processor's instruction set."""
    return load_kernels("clear_strategies.kernels")


def photometric(
    x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], lambda_ssim: float, out: Float[Tensor, "H W 3"] | None = None
) -> LossAndGradient:
    """(1 - λ) ‖x - y‖₁ + λ (1 - SSIM(x, y)), with its gradient, in one pass; with λ = 0 no SSIM is computed."""
    images = image_pair(DEVICES, x, y, out)
    l1_mean, dissimilarity = native().photometric(*images, 1 - lambda_ssim, lambda_ssim, threads())
    return _result((1 - lambda_ssim) * l1_mean + lambda_ssim * dissimilarity, images)


def haar_l1(
    x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], levels: int = 1, out: Float[Tensor, "H W 3"] | None = None
) -> LossAndGradient:
    """Mean absolute difference of the three detail bands of an orthonormal Haar transform, averaged over levels."""
    if levels < 1:
        raise ValueError(f"levels must be at least 1, got {levels}.")
    images = image_pair(DEVICES, x, y, out)
    return _result(native().haar_l1(*images, levels, threads()), images)


def _result(value: float, images: ImagePair) -> LossAndGradient:
    return LossAndGradient(torch.tensor(value, dtype=torch.float32), images.gradient)
