"""The losses of `torch`, same names and meaning, by compiled kernels in float32: for images [H, W, 3] on the CPU.

SSIM keeps its digits without float64: sums are taken about a value inside each window (`src/ssim.hpp`). The same bits for
any number of threads, which are as many as torch uses.

Every function here raises `BackendUnavailable` where the kernels were not built, `TypeError` for images that are not
float32 tensors on the CPU, and `ValueError` for sizes that do not fit.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.torch import LossAndGradient
from rasterizers.interface import BackendUnavailable
from rasterizers.native import load_kernels, threads


def available() -> bool:
    """Whether the kernels were built and run on this processor."""
    try:
        native()
    except BackendUnavailable:
        return False
    return True


@cache
def native() -> ModuleType:
    """The module for this processor's instruction set."""
    return load_kernels("clear_strategies.kernels")


def accepts(*images: Tensor) -> bool:
    """Whether these images are of the type and shape that the kernels are written for."""
    return all(
        image.dtype == torch.float32 and image.device.type == "cpu" and image.ndim == 3 and image.shape[2] == 3
        for image in images
    ) and not any(image.numel() == 0 for image in images)


def photometric(
    x: Float[Tensor, "H W 3"],
    y: Float[Tensor, "H W 3"],
    lambda_ssim: float,
    out: Float[Tensor, "H W 3"] | None = None,
) -> LossAndGradient:
    """(1 - λ) ‖x - y‖₁ + λ (1 - SSIM(x, y)), with its gradient, in one pass; without λ no SSIM is computed."""
    tensors = _prepared(x, y, out)
    l1_mean, dissimilarity = native().photometric(*tensors, 1 - lambda_ssim, lambda_ssim, threads())
    return _answer((1 - lambda_ssim) * l1_mean + lambda_ssim * dissimilarity, tensors)


def l1(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> LossAndGradient:
    """Mean absolute difference; where x = y the gradient is 0."""
    return photometric(x, y, 0.0)


def ssim(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> LossAndGradient:
    """Mean structural similarity as 3DGS trains with it: zero padding, so borders count less."""
    tensors = _prepared(x, y, None)
    _, dissimilarity = native().photometric(*tensors, 0.0, -1.0, threads())  # SSIM - 1, and its gradient
    return _answer(1 - dissimilarity, tensors)


def haar_l1(
    x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], levels: int = 1, out: Float[Tensor, "H W 3"] | None = None
) -> LossAndGradient:
    """Mean absolute difference of the three detail bands of an orthonormal Haar transform, averaged over levels."""
    if levels < 1:
        raise ValueError(f"levels must be at least 1, got {levels}.")
    tensors = _prepared(x, y, out)
    return _answer(native().haar_l1(*tensors, levels, threads()), tensors)


class _Tensors(NamedTuple):
    x: Tensor
    y: Tensor
    gradient: Tensor


def _prepared(x: Tensor, y: Tensor, out: Tensor | None) -> _Tensors:
    """The images, contiguous, and where the gradient goes."""
    for name, image in (("x", x), ("y", y), ("out", out)):
        if image is None:
            continue
        if image.dtype != torch.float32 or image.device.type != "cpu":
            raise TypeError(
                f"{name} must be float32 on the CPU, got {image.dtype} on {image.device}; kernels=torch takes any."
            )
        if image.ndim != 3 or image.shape[2] != 3 or image.shape != x.shape or image.numel() == 0:
            raise ValueError(
                f"{name} must be an image [H, W, 3] with pixels, and as large as x; got {tuple(image.shape)} "
                f"beside {tuple(x.shape)}."
            )
    gradient = torch.empty_like(x, memory_format=torch.contiguous_format, requires_grad=False) if out is None else out
    if not gradient.is_contiguous():
        raise ValueError(f"out must be contiguous, got strides {gradient.stride()}.")
    return _Tensors(x.detach().contiguous(), y.detach().contiguous(), gradient)


def _answer(value: float, tensors: _Tensors) -> LossAndGradient:
    return LossAndGradient(torch.tensor(value, dtype=torch.float32), tensors.gradient)
