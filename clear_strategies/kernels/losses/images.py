"""The images that the compiled losses support: float32 [H, W, 3] on a device that the kernels run on."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

import torch
from torch import Tensor

DEVICES: Final = {"cpp": ("cpu",), "warp": ("cuda", "cpu")}
"""The devices of each compiled implementation."""


def supported(*images: Tensor) -> bool:
    """Return True for floating-point images [H, W, 3] with pixels; compiled losses support no others."""
    return all(
        image.is_floating_point() and image.ndim == 3 and image.shape[2] == 3 and image.numel() for image in images
    )


def image_pair(devices: Collection[str], x: Tensor, y: Tensor, out: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """The images as kernels for `devices` read them, contiguous and detached, and the tensor that receives the gradient.

    Args:
        out: contiguous, as large as x; None: a new one.

    Raises:
        TypeError: an image is not float32, or not on such a device, or not on the same device as x.
        ValueError: an image is not [H, W, 3], or not as large as x.
    """
    for name, image in (("x", x), ("y", y)):
        if image.dtype != torch.float32 or image.device.type not in devices or image.device != x.device:
            raise TypeError(
                f"{name} must be float32 on {' or '.join(devices)}, where x is, got {image.dtype} on {image.device}; "
                "kernels=torch supports any."
            )
        if image.ndim != 3 or image.shape[2] != 3 or image.shape != x.shape or image.numel() == 0:
            raise ValueError(
                f"{name} must be an image [H, W, 3] with pixels, and as large as x; got {tuple(image.shape)} "
                f"beside {tuple(x.shape)}."
            )
    x, y = x.detach().contiguous(), y.detach().contiguous()
    return x, y, torch.empty_like(x) if out is None else out
