"""The images that compiled kernels take: float32, [H, W, 3], in the memory of a device that they run on."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final, NamedTuple

import torch
from torch import Tensor

_SPOKEN: Final = {"cpu": "the CPU", "cuda": "CUDA"}


class Prepared(NamedTuple):
    """Both images, contiguous and free of any graph, and where the gradient goes."""

    x: Tensor
    y: Tensor
    gradient: Tensor


def takes(devices: Collection[str], *images: Tensor) -> bool:
    """Whether these images are of the type and shape that compiled kernels for `devices` are written for."""
    return all(
        image.dtype == torch.float32
        and image.device.type in devices
        and image.device == images[0].device
        and image.ndim == 3
        and image.shape[2] == 3
        and image.numel() > 0
        for image in images
    )


def prepared(devices: Collection[str], x: Tensor, y: Tensor, out: Tensor | None) -> Prepared:
    """The images as kernels for `devices` read them.

    Raises:
        TypeError: one is not float32 on such a device, or is on another than x.
        ValueError: one is no image [H, W, 3], or not as large as x; or `out` is not contiguous.
    """
    for name, image in (("x", x), ("y", y), ("out", out)):
        if image is None:
            continue
        if image.dtype != torch.float32 or image.device.type not in devices:
            raise TypeError(
                f"{name} must be float32 on {' or '.join(_SPOKEN[device] for device in devices)}, got {image.dtype} on "
                f"{image.device}; kernels=torch takes any."
            )
        if image.device != x.device:
            raise TypeError(f"{name} must be where x is, on {x.device}, got {image.device}.")
        if image.ndim != 3 or image.shape[2] != 3 or image.shape != x.shape or image.numel() == 0:
            raise ValueError(
                f"{name} must be an image [H, W, 3] with pixels, and as large as x; got {tuple(image.shape)} "
                f"beside {tuple(x.shape)}."
            )
    gradient = torch.empty_like(x, memory_format=torch.contiguous_format, requires_grad=False) if out is None else out
    if not gradient.is_contiguous():
        raise ValueError(f"out must be contiguous, got strides {gradient.stride()}.")
    return Prepared(x.detach().contiguous(), y.detach().contiguous(), gradient)
