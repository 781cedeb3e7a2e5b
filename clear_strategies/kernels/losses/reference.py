"""The reference implementation of the image losses, each with its gradient with respect to the first image.

The gradients are written by hand, without autograd, because the trainer needs only gradients of images. A function with an
argument `out` writes the gradient to that tensor and returns it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

_WINDOW: Final = 11  # 3DGS: 11 x 11 Gaussian window of σ = 1.5, zero padding
_SIGMA: Final = 1.5
_C1: Final = 0.01**2
_C2: Final = 0.03**2


class LossAndGradient(NamedTuple):
    """A loss, and its gradient with respect to the first image."""

    value: Float[Tensor, ""]
    gradient: Float[Tensor, "H W C"]


def photometric(
    x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"], lambda_ssim: float, out: Float[Tensor, "H W C"] | None = None
) -> LossAndGradient:
    """(1 - λ) ‖x - y‖₁ + λ (1 - SSIM(x, y)), with its gradient; with λ = 0 no SSIM is computed."""
    value, gradient = l1(x, y)
    if lambda_ssim > 0:
        similarity = ssim(x, y)
        value = (1 - lambda_ssim) * value + lambda_ssim * (1 - similarity.value)
        gradient = (1 - lambda_ssim) * gradient - lambda_ssim * similarity.gradient
    return LossAndGradient(value, gradient if out is None else out.copy_(gradient))


def l1(x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"]) -> LossAndGradient:
    """Mean absolute difference; where x = y the gradient is 0."""
    difference = x - y
    return LossAndGradient(difference.abs().mean(), difference.sign() / difference.numel())


def ssim(x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"], inset: int = 0) -> LossAndGradient:
    """Mean structural similarity as 3DGS trains with it: zero padding, so borders count less.

    The mean is over the windows about pixels that are at least `inset` from the border.

    With A1 = 2 μx μy + C1, A2 = 2 σxy + C2, B1 = μx² + μy² + C1, B2 = σx² + σy² + C2, the map is S = A1 A2 / (B1 B2).
    Computed in float64, because E[x²] - E[x]² in float32 loses the variance of flat regions. For evaluation use
    `outputs.metrics`, which follows scikit-image.
    """
    if not 0 <= 2 * inset < min(x.shape[:2]):
        raise ValueError("no window lies so far inside the images.")  # as C++ does
    X, Y = x.double().movedim(-1, 0), y.double().movedim(-1, 0)
    mu_x, mu_y, e_xx, e_yy, e_xy = _window_mean(torch.stack((X, Y, X * X, Y * Y, X * Y)))
    A1, A2 = 2 * mu_x * mu_y + _C1, 2 * (e_xy - mu_x * mu_y) + _C2
    B1, B2 = mu_x * mu_x + mu_y * mu_y + _C1, (e_xx - mu_x * mu_x) + (e_yy - mu_y * mu_y) + _C2
    S = A1 * A2 / (B1 * B2)
    counted = torch.zeros_like(S)
    within = (..., slice(inset, S.shape[-2] - inset), slice(inset, S.shape[-1] - inset))
    counted[within] = 1 / S[within].numel()

    # S depends on x through the three local means μx, E[xx], E[xy]; the window mean is its own transpose.
    d_mu_x = 2 * mu_y * (A2 - A1) / (B1 * B2) + 2 * mu_x * S * (1 / B2 - 1 / B1)
    d_e_xx = -S / B2
    d_e_xy = 2 * A1 / (B1 * B2)
    g_mu, g_xx, g_xy = _window_mean(torch.stack((d_mu_x, d_e_xx, d_e_xy)) * counted)
    gradient = g_mu + 2 * X * g_xx + Y * g_xy
    return LossAndGradient(S[within].mean().to(x.dtype), gradient.movedim(0, -1).to(x.dtype))


def haar_l1(
    x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"], levels: int = 1, out: Float[Tensor, "H W C"] | None = None
) -> LossAndGradient:
    """Mean absolute difference of the three detail bands of an orthonormal Haar transform, averaged over levels.

    It does not depend on the mean of each 2 × 2 block. An odd last row or column is repeated, so every pixel counts.
    """
    low = x - y  # the transform is linear
    sizes, signs = [], []
    value = torch.zeros((), dtype=x.dtype, device=x.device)
    for _ in range(levels):
        sizes.append(low.shape)
        low, details = _haar(_pad_to_even(low))
        value = value + details.abs().mean() / levels
        signs.append(details.sign() / (details.numel() * levels))
    gradient = torch.zeros_like(low)
    for shape, details in zip(reversed(sizes), reversed(signs), strict=True):
        gradient = _fold_padding(_inverse_haar(gradient, details), shape)
    return LossAndGradient(value, gradient if out is None else out.copy_(gradient))


def _haar(image: Float[Tensor, "H W C"]) -> tuple[Float[Tensor, "h w C"], Float[Tensor, "3 h w C"]]:
    a, b, c, d = image[0::2, 0::2], image[0::2, 1::2], image[1::2, 0::2], image[1::2, 1::2]
    details = torch.stack((a - b + c - d, a + b - c - d, a - b - c + d)) / 2
    return (a + b + c + d) / 2, details


def _inverse_haar(low: Float[Tensor, "h w C"], details: Float[Tensor, "3 h w C"]) -> Float[Tensor, "H W C"]:
    horizontal, vertical, diagonal = details
    image = low.new_empty(low.shape[0] * 2, low.shape[1] * 2, low.shape[2])
    image[0::2, 0::2] = (low + horizontal + vertical + diagonal) / 2
    image[0::2, 1::2] = (low - horizontal + vertical - diagonal) / 2
    image[1::2, 0::2] = (low + horizontal - vertical - diagonal) / 2
    image[1::2, 1::2] = (low - horizontal - vertical + diagonal) / 2
    return image


def _pad_to_even(image: Float[Tensor, "H W C"]) -> Float[Tensor, "h w C"]:
    if image.shape[0] % 2:
        image = torch.cat((image, image[-1:]), dim=0)
    if image.shape[1] % 2:
        image = torch.cat((image, image[:, -1:]), dim=1)
    return image


def _fold_padding(gradient: Float[Tensor, "h w C"], shape: torch.Size) -> Float[Tensor, "H W C"]:
    """The VJP of `_pad_to_even`: a repeated pixel receives both gradients."""
    height, width = shape[:2]
    if gradient.shape[1] > width:
        gradient[:, width - 1] += gradient[:, width]
    if gradient.shape[0] > height:
        gradient[height - 1] += gradient[height]
    return gradient[:height, :width]


def _window_mean(maps: Float[Tensor, "... H W"]) -> Float[Tensor, "... H W"]:
    """Separable Gaussian mean with zero padding, as eleven shifted sums per axis (torch's grouped convolution is slower)."""
    return _mean_along(_mean_along(maps, -1), -2)


def _mean_along(maps: Float[Tensor, "... H W"], dim: int) -> Float[Tensor, "... H W"]:
    size, reach = maps.shape[dim], _WINDOW // 2
    out = torch.zeros_like(maps)
    for offset, weight in zip(range(-reach, reach + 1), gaussian_window(), strict=True):
        overlap = size - abs(offset)
        if overlap > 0:
            source = maps.narrow(dim, max(offset, 0), overlap)
            out.narrow(dim, max(-offset, 0), overlap).add_(source, alpha=weight)
    return out


@lru_cache(maxsize=1)
def gaussian_window() -> tuple[float, ...]:
    offsets = torch.arange(_WINDOW, dtype=torch.float64, device="cpu") - _WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / _SIGMA) ** 2)
    return tuple((weights / weights.sum()).tolist())
