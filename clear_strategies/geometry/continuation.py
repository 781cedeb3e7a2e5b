"""Smooth continuation: colours for the pixels that no photo tells, from those around them.

A pyramid of means: each level halves the one before and knows a pixel if it knows one of the four below. From the coarsest
level, which knows everything, each unknown pixel takes what the coarser level shows there. The further away the known ones are,
the smoother the continuation: nothing sharp is invented.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def continued(image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """`image` where it is known, elsewhere the colours around it; `image` itself where nothing is known.

    Args:
        known: where `image` shows something; its other pixels are not read.
    """
    if not bool(known.any()):
        return image
    mask = known[None, None].to(image)
    colors = torch.where(known[..., None], image, 0.0).permute(2, 0, 1)[None]
    return _filled(colors, mask)[0].permute(1, 2, 0).clamp(0, 1)


def _filled(colors: Float[Tensor, "1 3 h w"], mask: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 3 h w"]:
    """
    Args:
        colors: 0 where `mask` is 0. mask: 1 where known, at one pixel at least.
    """
    if bool(mask.all()):
        return colors
    sums, share = (F.avg_pool2d(x, 2, ceil_mode=True) for x in (colors, mask))  # of each block of four
    coarse = _filled(sums / share.clamp_min(torch.finfo(share.dtype).tiny), (share > 0).to(mask))
    height, width = mask.shape[2:]
    finer = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)[..., :height, :width]
    return torch.where(mask > 0, colors, finer)
