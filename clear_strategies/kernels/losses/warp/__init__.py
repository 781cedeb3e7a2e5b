"""The losses of `reference` in NVIDIA Warp, for float32 images [H, W, 3] on CUDA; the same kernels run on a CPU, to check them.

Importing this package imports Warp. Losses stay on the device, and the host does not wait for it. All work runs on torch's
current stream in memory of torch's allocator. Results have the same bits in every run.
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses.images import DEVICES, image_pair
from clear_strategies.kernels.losses.reference import LossAndGradient
from clear_strategies.kernels.losses.warp import haar, similarity, sums
from rasterizers.warp_runtime import lanes_on, launch, on_stream

LANES: Final = 256  # threads per block, see `lanes_on`


def photometric(x: Tensor, y: Tensor, lambda_ssim: float, out: Tensor | None = None) -> LossAndGradient:
    """See `losses.photometric`."""
    x, y, out = image_pair(DEVICES["warp"], x, y, out)
    height, width = x.shape[0], 3 * x.shape[1]
    l1_share, dssim_share = (1 - lambda_ssim) / x.numel(), lambda_ssim / x.numel()
    with on_stream(x.device):
        if lambda_ssim == 0:
            parts = _parts(x, height)
            launch(sums.absolute, [height], (x, y, l1_share, l1_share, out, parts), block=LANES, together=True)
        else:
            blocks = [-(-height // similarity.ROWS), -(-width // similarity.STRIDE)]
            parts, maps = _parts(x, blocks[0] * blocks[1]), x.new_empty(similarity.MAPS, height, width)
            lanes, steps = lanes_on(x.device, LANES), (l1_share, l1_share, -dssim_share)
            launch(similarity.similarity(lanes), blocks, (x, y, dssim_share, maps, parts), block=LANES, together=True)
            launch(similarity.gradient(lanes), blocks, (x, y, maps, *steps, out, parts), block=LANES, together=True)
        return LossAndGradient(_total(parts), out)


def haar_l1(x: Tensor, y: Tensor, levels: int = 1, out: Tensor | None = None) -> LossAndGradient:
    """See `losses.haar_l1`."""
    x, y, out = image_pair(DEVICES["warp"], x, y, out)
    with on_stream(x.device):
        pyramid = [x]  # the input of each level; the first one is x - y
        for _ in range(levels - 1):
            finer = pyramid[-1]
            low = finer.new_empty(-(-finer.shape[0] // 2), -(-finer.shape[1] // 2), 3)
            launch(haar.low_part, low.shape[:2], (finer, y if finer is x else None, low))
            pyramid.append(low)
        rows = [-(-level.shape[0] // 2) for level in pyramid]  # of blocks
        parts, above = _parts(x, sum(rows)), None
        for level, level_parts in zip(reversed(pyramid), reversed(torch.split(parts, rows)), strict=True):
            gradient = out if level is x else torch.empty_like(level)
            weight = 1 / (9 * len(level_parts) * -(-level.shape[1] // 2) * levels)  # three details of three channels
            given = level, y if level is x else None, above, weight, gradient, level_parts
            launch(haar.details, [len(level_parts)], given, block=LANES, together=True)
            above = gradient
        return LossAndGradient(_total(parts), out)


def _parts(like: Tensor, blocks: int) -> Tensor:
    return like.new_empty(blocks, dtype=torch.float64)


def _total(parts: Tensor) -> Float[Tensor, ""]:
    value = parts.new_empty((), dtype=torch.float32)
    launch(sums.total, [1], (parts, value), block=LANES, together=True)
    return value
