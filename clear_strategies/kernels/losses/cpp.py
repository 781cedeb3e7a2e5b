"""The losses of `reference` in C++, for float32 images [H, W, 3] on the CPU.

SSIM is accurate in float32 because sums are taken about a value inside each window (`kernels/src/ssim.hpp`). Results have
the same bits for any number of threads.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from clear_strategies.kernels import native
from clear_strategies.kernels.losses.images import DEVICES, image_pair
from clear_strategies.kernels.losses.reference import LossAndGradient
from rasterizers.native import threads


def photometric(x: Tensor, y: Tensor, lambda_ssim: float, out: Tensor | None = None) -> LossAndGradient:
    """See `losses.photometric`; in one pass."""
    return _weighted(x, y, 1 - lambda_ssim, lambda_ssim, 0, out)


def ssim(x: Tensor, y: Tensor, inset: int = 0) -> LossAndGradient:
    """See `losses.ssim`."""
    value, gradient = _weighted(x, y, 0.0, -1.0, inset)
    return LossAndGradient(1 + value, gradient)


def haar_l1(x: Tensor, y: Tensor, levels: int = 1, out: Tensor | None = None) -> LossAndGradient:
    """See `losses.haar_l1`."""
    x, y, gradient = image_pair(DEVICES["cpp"], x, y, out)
    return _loss(native.module().haar_l1(x, y, gradient, levels, threads()), gradient)


def _weighted(x: Tensor, y: Tensor, l1: float, dssim: float, inset: int, out: Tensor | None = None) -> LossAndGradient:
    """The value l1 · mean |x - y| + dssim · (1 - SSIM); with dssim = 0 no SSIM is computed."""
    x, y, gradient = image_pair(DEVICES["cpp"], x, y, out)
    l1_mean, dissimilarity = native.module().photometric(x, y, gradient, l1, dssim, inset, threads())
    return _loss(l1 * l1_mean + dssim * dissimilarity, gradient)


def _loss(value: float, gradient: Tensor) -> LossAndGradient:
    scalar = torch.from_numpy(np.asarray(value, np.float32))  # `torch.tensor` is an operation of its own
    return LossAndGradient(scalar, gradient)
