"""The losses of `reference` in C++, for float32 images [H, W, 3] on the CPU.

SSIM is accurate in float32 because sums are taken about a value inside each window (`kernels/src/ssim.hpp`). Results have
the same bits for any number of threads. Gradients are written to `images.gradient`.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses.images import ImagePair
from rasterizers.interface import BackendUnavailable
from rasterizers.native import load_kernels, threads


def available() -> bool:
    """Whether the kernels were compiled and run on this processor."""
    try:
        native()
    except BackendUnavailable:
        return False
    return True


def native() -> ModuleType:
    """The compiled module for this processor's instruction set."""
    return load_kernels("clear_strategies.kernels")


def photometric(images: ImagePair, l1: float, dssim: float) -> Float[Tensor, ""]:
    """The value l1 · mean |x - y| + dssim · (1 - SSIM), in one pass; with dssim = 0 no SSIM is computed."""
    l1_mean, dissimilarity = native().photometric(*images, l1, dssim, threads())
    return _scalar(l1 * l1_mean + dssim * dissimilarity)


def haar_l1(images: ImagePair, levels: int) -> Float[Tensor, ""]:
    """The mean |detail| of each level, averaged over the levels."""
    return _scalar(native().haar_l1(*images, levels, threads()))


def _scalar(value: float) -> Float[Tensor, ""]:
    """By numpy: `torch.tensor` is an operation of its own."""
    return torch.from_numpy(np.asarray(value, np.float32))
