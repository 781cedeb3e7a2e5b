"""`fused_ssim`, the loss of 3DGS and of gsplat's examples."""

from __future__ import annotations

from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses import ssim

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
    return _MeanSsim.apply(img1, img2, _REACH if padding == "valid" else 0)  # type: ignore[no-untyped-call, no-any-return]


class _MeanSsim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor, inset: int) -> Tensor:
        pairs = zip(first.permute(0, 2, 3, 1), second.permute(0, 2, 3, 1), strict=True)
        values, gradients = zip(*(ssim(x, y, inset) for x, y in pairs), strict=True)
        ctx.save_for_backward(torch.stack(gradients).permute(0, 3, 1, 2) / len(values))
        return torch.stack(values).mean()

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return cotangent * ctx.saved_tensors[0], None, None
