"""`fused_ssim`, the loss of 3DGS and of gsplat's examples."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses import ssim
from integration.loss import with_gradients

_REACH: Final = 5  # of a window, beside its pixel


def fused_ssim(
    img1: Float[Tensor, "B C H W"], img2: Float[Tensor, "B C H W"], padding: str = "same", train: bool = True
) -> Float[Tensor, ""]:
    """The mean SSIM of two batches of images, differentiable in the first.

    Args:
        padding: "same": all windows, over zeros beyond the images; "valid": the windows inside them.
        train: without effect.

    Raises:
        ValueError: another padding.
    """
    if padding not in ("same", "valid"):
        raise ValueError(f"padding must be 'same' or 'valid', got {padding!r}.")
    inset = _REACH if padding == "valid" else 0
    pairs = zip(*(images.detach().permute(0, 2, 3, 1) for images in (img1, img2)), strict=True)
    values, gradients = zip(*(ssim(x, y, inset) for x, y in pairs), strict=True)
    gradient = torch.stack(gradients).permute(0, 3, 1, 2) / len(values)
    return with_gradients(torch.stack(values).mean(), [gradient], img1)
