"""The losses of `reference` in NVIDIA Warp, for float32 images [H, W, 3] on CUDA; the same kernels run on a CPU, to check them.

This module does not import Warp until a loss is computed. Losses stay on the device, and the host does not wait for it. All
work runs on torch's current stream in memory of torch's allocator. Results have the same bits in every run.

Every loss raises `BackendUnavailable` if Warp is not available, `TypeError` for images that are not float32 on one device,
and `ValueError` for sizes that do not match.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import Final

from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses.images import image_pair
from clear_strategies.kernels.losses.reference import LossAndGradient
from rasterizers.interface import BackendUnavailable
from rasterizers.warp_runtime import require_warp

DEVICES: Final = ("cuda", "cpu")


@cache
def available(device: str = "cuda") -> bool:
    """Whether the kernels run on "cuda", or on "cpu"."""
    try:
        require(device)
    except BackendUnavailable:
        return False
    return True


@cache
def require(device: str) -> None:
    """Check that Warp runs on this device.

    Raises:
        BackendUnavailable: it does not; the message says why.
    """
    require_warp("kernels=warp", device, "kernels=torch runs here")


def photometric(
    x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], lambda_ssim: float, out: Float[Tensor, "H W 3"] | None = None
) -> LossAndGradient:
    """(1 - λ) ‖x - y‖₁ + λ (1 - SSIM(x, y)), with its gradient; with λ = 0 no SSIM is computed."""
    images = image_pair(DEVICES, x, y, out)
    return LossAndGradient(_launches(x).photometric(images, 1 - lambda_ssim, lambda_ssim), images.gradient)


def haar_l1(
    x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], levels: int = 1, out: Float[Tensor, "H W 3"] | None = None
) -> LossAndGradient:
    """Mean absolute difference of the three detail bands of an orthonormal Haar transform, averaged over levels."""
    if levels < 1:
        raise ValueError(f"levels must be at least 1, got {levels}.")
    images = image_pair(DEVICES, x, y, out)
    return LossAndGradient(_launches(x).haar_l1(images, levels), images.gradient)


def _launches(image: Tensor) -> ModuleType:
    require(image.device.type)
    from clear_strategies.kernels.losses.warp import launches

    return launches
