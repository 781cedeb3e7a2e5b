"""The losses of `torch`, same names and meaning, by NVIDIA Warp in float32: for images [H, W, 3] on CUDA, and on a CPU to
check them. This file knows whether Warp runs here and launches what the others hold; Warp is imported when it is needed.

Values stay on the device, and nothing here waits for it. All work goes to torch's current stream, all memory is torch's.
The same bits from run to run: a value is summed in one order, a gradient is gathered.

Every function here raises `BackendUnavailable` where Warp is not to be had, `TypeError` for images that are not float32
tensors on one device, and `ValueError` for sizes that do not fit.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import Final

from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses.prepared import prepared, takes
from clear_strategies.kernels.losses.reference import LossAndGradient
from rasterizers.interface import BackendUnavailable
from rasterizers.warp_backend.launch import require

_DEVICES: Final = ("cuda", "cpu")


@cache
def available(device: str = "cuda") -> bool:
    """Whether the kernels run on "cuda", or on "cpu"."""
    try:
        needed(device)
    except BackendUnavailable:
        return False
    return True


@cache
def needed(device: str) -> None:
    """Make sure of Warp.

    Raises:
        BackendUnavailable: it is not installed, or does not run on this device.
    """
    require("kernels=warp", device, "kernels=torch runs here")


def accepts(*images: Tensor) -> bool:
    """Whether these images are of the type and shape that the kernels are written for."""
    return takes(_DEVICES, *images)


def photometric(
    x: Float[Tensor, "H W 3"],
    y: Float[Tensor, "H W 3"],
    lambda_ssim: float,
    out: Float[Tensor, "H W 3"] | None = None,
) -> LossAndGradient:
    """(1 - λ) ‖x - y‖₁ + λ (1 - SSIM(x, y)), with its gradient; without λ no SSIM is computed."""
    images = prepared(_DEVICES, x, y, out)
    return LossAndGradient(_launches(x).photometric(images, 1 - lambda_ssim, lambda_ssim), images.gradient)


def l1(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> LossAndGradient:
    """Mean absolute difference; where x = y the gradient is 0."""
    return photometric(x, y, 0.0)


def ssim(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> LossAndGradient:
    """Mean structural similarity as 3DGS trains with it: zero padding, so borders count less."""
    images = prepared(_DEVICES, x, y, None)
    return LossAndGradient(_launches(x).photometric(images, 0.0, -1.0, 1.0), images.gradient)  # 1 - (1 - SSIM)


def haar_l1(
    x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], levels: int = 1, out: Float[Tensor, "H W 3"] | None = None
) -> LossAndGradient:
    """Mean absolute difference of the three detail bands of an orthonormal Haar transform, averaged over levels."""
    if levels < 1:
        raise ValueError(f"levels must be at least 1, got {levels}.")
    images = prepared(_DEVICES, x, y, out)
    return LossAndGradient(_launches(x).haar_l1(images, levels), images.gradient)


def _launches(image: Tensor) -> ModuleType:
    needed(image.device.type)
    from clear_strategies.kernels.losses.warp import launches

    return launches
