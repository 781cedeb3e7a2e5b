"""Image losses with their gradients, in three implementations.

`reference` specifies the losses in torch, in float64 internally. `cpp` (the CPU) and `warp` (CUDA) compute the same for float32
images. Every function has an argument `kernels`: "torch", "cpp", "warp", or "auto" for the fastest that supports the images.
"""

from __future__ import annotations

import logging
from functools import cache
from typing import Literal, Protocol, get_args, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from clear_strategies.errors import SettingError
from clear_strategies.kernels.losses import cpp, warp
from clear_strategies.kernels.losses import reference as reference
from clear_strategies.kernels.losses.images import supported
from clear_strategies.kernels.losses.reference import LossAndGradient

__all__ = ["Choice", "Implementation", "LossAndGradient", "haar_l1", "implementations", "photometric", "require"]

_log = logging.getLogger(__name__)

Choice = Literal["auto", "torch", "cpp", "warp"]


@runtime_checkable
class Implementation(Protocol):
    """The functions of an implementation; `reference` specifies them."""

    def photometric(self, x: Tensor, y: Tensor, lambda_ssim: float, out: Tensor | None = None) -> LossAndGradient: ...

    def haar_l1(self, x: Tensor, y: Tensor, levels: int = 1, out: Tensor | None = None) -> LossAndGradient: ...


def implementations(device: str = "cpu") -> dict[str, Implementation]:
    """The implementations for images on `device`, "cpu" or "cuda", by name, fastest first.

    Warp's kernels on a CPU are for checks, and are not listed.
    """
    found: dict[str, Implementation] = {}
    if device == "cpu" and cpp.available():
        found["cpp"] = cpp
    if device == "cuda" and warp.available():
        found["warp"] = warp
    return found | {"torch": reference}


def require(kernels: Choice) -> None:
    """Check that an implementation can run, before the first image.

    Raises:
        SettingError: there is no such implementation.
        BackendUnavailable: "cpp" was not compiled, or Warp is not installed; the message says what to do.
    """
    if kernels not in get_args(Choice):
        raise SettingError(f"kernels must be one of {', '.join(get_args(Choice))}, got {kernels!r}.")
    if kernels == "cpp":
        cpp.native()
    if kernels == "warp":
        warp.require("cpu")


def photometric(
    x: Float[Tensor, "H W C"],
    y: Float[Tensor, "H W C"],
    lambda_ssim: float,
    *,
    kernels: Choice = "auto",
    out: Float[Tensor, "H W C"] | None = None,
) -> LossAndGradient:
    """(1 - λ) ‖x - y‖₁ + λ (1 - SSIM(x, y)), with its gradient with respect to x, written into `out` if given."""
    return _choose(kernels, x, y).photometric(x, y, lambda_ssim, out)


def haar_l1(
    x: Float[Tensor, "H W C"],
    y: Float[Tensor, "H W C"],
    levels: int = 1,
    *,
    kernels: Choice = "auto",
    out: Float[Tensor, "H W C"] | None = None,
) -> LossAndGradient:
    """Mean absolute difference of Haar details, averaged over levels, with its gradient, written into `out` if given."""
    return _choose(kernels, x, y).haar_l1(x, y, levels, out)


def _choose(kernels: Choice, x: Tensor, y: Tensor) -> Implementation:
    require(kernels)
    if kernels == "auto":
        kernels = _fastest(x, y)
    _log_once(f"cpp, for {cpp.native().isa}" if kernels == "cpp" else kernels)
    return {"torch": reference, "cpp": cpp, "warp": warp}[kernels]


def _fastest(x: Tensor, y: Tensor) -> Choice:
    if x.device.type == "cpu":
        return "cpp" if supported(cpp.DEVICES, x, y) and cpp.available() else "torch"
    return "warp" if supported(warp.DEVICES, x, y) and warp.available() else "torch"


@cache
def _log_once(which: str) -> None:
    _log.debug("image losses: %s.", which)
