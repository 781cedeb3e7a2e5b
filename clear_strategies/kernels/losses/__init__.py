"""Image losses with their gradients, in three implementations.

`reference` specifies the losses in torch, in float64 internally. `cpp` (the CPU) and `warp` (CUDA) compute the same for float32
images [H, W, 3]. Every function has an argument `kernels`: "torch", "cpp", "warp", or "auto" for the fastest that supports the
images. A chosen implementation raises `TypeError` or `ValueError` for images that it does not support, and
`BackendUnavailable` if it does not run here.
"""

from __future__ import annotations

import logging
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Literal, get_args

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import require_choice
from clear_strategies.kernels import native
from clear_strategies.kernels.losses import reference
from clear_strategies.kernels.losses.images import supported
from clear_strategies.kernels.losses.reference import LossAndGradient
from rasterizers.warp_runtime import require_warp

__all__ = ["Choice", "LossAndGradient", "haar_l1", "photometric", "require", "ssim"]

_log = logging.getLogger(__name__)

Choice = Literal["auto", "torch", "cpp", "warp"]


def require(kernels: Choice, device: str = "cpu") -> None:
    """Check that an implementation can run on "cpu" or "cuda", before the first image.

    Raises:
        SettingError: there is no such implementation.
        BackendUnavailable: "cpp" was not compiled, or Warp is not installed; the message says what to do.
    """
    require_choice("kernels", kernels, get_args(Choice))
    if kernels == "cpp":
        native.module()
    if kernels == "warp":
        require_warp("kernels=warp", device, "kernels=torch runs here")


def photometric(
    x: Float[Tensor, "H W C"],
    y: Float[Tensor, "H W C"],
    lambda_ssim: float,
    *,
    kernels: Choice = "auto",
    out: Float[Tensor, "H W C"] | None = None,
) -> LossAndGradient:
    """(1 - λ) ‖x - y‖₁ + λ (1 - SSIM(x, y)), with its gradient with respect to x, written into `out` if given.

    With λ = 0 no SSIM is computed.
    """
    loss: LossAndGradient = _chosen(kernels, x, y).photometric(x, y, lambda_ssim, out)
    return loss


def ssim(x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"], inset: int = 0) -> LossAndGradient:
    """The mean SSIM of the windows about pixels at least `inset` from the border, with its gradient with respect to x.

    On the CPU in C++ where that supports the images, else in torch. Both images must be finite everywhere.

    Raises:
        ValueError: there is no such pixel.
    """
    loss: LossAndGradient = getattr(_chosen("auto", x, y), "ssim", reference.ssim)(x, y, inset)
    return loss


def haar_l1(
    x: Float[Tensor, "H W C"],
    y: Float[Tensor, "H W C"],
    levels: int = 1,
    *,
    kernels: Choice = "auto",
    out: Float[Tensor, "H W C"] | None = None,
) -> LossAndGradient:
    """Mean absolute difference of Haar details, averaged over levels, with its gradient, written into `out` if given."""
    if levels < 1:
        raise ValueError(f"levels must be at least 1, got {levels}.")
    loss: LossAndGradient = _chosen(kernels, x, y).haar_l1(x, y, levels, out)
    return loss


def _chosen(kernels: Choice, x: Tensor, y: Tensor) -> ModuleType:
    """The implementation, a module with the functions of `reference`."""
    if kernels == "auto":
        module = native.implementation(__name__, x, y) if supported(x, y) else reference
    else:
        require(kernels, x.device.type)
        module = import_module(f"{__name__}.{'reference' if kernels == 'torch' else kernels}")
    _log_once(module.__name__.rpartition(".")[2])
    return module


@cache
def _log_once(which: str) -> None:
    _log.debug("image losses: %s.", f"cpp, for {native.module().isa}" if which == "cpp" else which)
