"""The losses of `reference` in C++, for float32 images [H, W, 3] on the CPU.

SSIM is accurate in float32 because sums are taken about a value inside each window (`kernels/src/ssim.hpp`). Results have
the same bits for any number of threads. Gradients are written to `images.gradient`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels import native
from clear_strategies.kernels.losses.images import ImagePair
from rasterizers.native import threads


def photometric(images: ImagePair, l1: float, dssim: float, inset: int = 0) -> Float[Tensor, ""]:
    """The value l1 · mean |x - y| + dssim · (1 - SSIM), in one pass; with dssim = 0 no SSIM is computed."""
    l1_mean, dissimilarity = native.module().photometric(*images, l1, dssim, inset, threads())
    return _scalar(l1 * l1_mean + dssim * dissimilarity)


def haar_l1(images: ImagePair, levels: int) -> Float[Tensor, ""]:
    """The mean |detail| of each level, averaged over the levels."""
    return _scalar(native.module().haar_l1(*images, levels, threads()))


def _scalar(value: float) -> Float[Tensor, ""]:
    """By numpy: `torch.tensor` is an operation of its own."""
    return torch.from_numpy(np.asarray(value, np.float32))
