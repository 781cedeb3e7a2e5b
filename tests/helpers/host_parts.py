"""What the stand-ins for other trainers share."""

from __future__ import annotations

import torch
from torch import Tensor

from clear_strategies.kernels import losses

FROM_START = ["objective.lambda_hr.start=0", "objective.lambda_hr.full=0", "strategies.p2g.patch=4"]
"""Settings of a run that is too short for the warm-up, and photos that are too small for P2G's patches."""


def photometric(image: Tensor, target: Tensor) -> Tensor:
    """A number whose gradient is that of 0.8 L1 + 0.2 (1 - SSIM), the hosts' loss; images [H, W, 3]."""
    return (
        image * losses.photometric(image.detach().contiguous(), target.contiguous(), 0.2, kernels="torch").gradient
    ).sum()


class InNdc(torch.autograd.Function):
    """Zero offsets of the projected centres; their gradient goes to a tensor of zeros, in NDC."""

    @staticmethod
    def forward(ctx, dummy, width, height, absolute=False):
        ctx.size, ctx.columns, ctx.absolute = (width, height), dummy.shape[1], absolute
        return dummy.new_zeros(len(dummy), 2)

    @staticmethod
    def backward(ctx, g):
        ndc = g.new_zeros(len(g), ctx.columns)
        ndc[:, :2] = g * g.new_tensor(ctx.size) / 2
        if ctx.columns == 4:  # some forks keep absolute gradients here
            ndc[:, 2:] = 3 * ndc[:, :2].abs()
        elif ctx.absolute:  # and Mip-Splatting keeps their norm in the third column
            ndc[:, 2] = 3 * ndc[:, :2].norm(dim=1)
        return ndc, None, None, None
