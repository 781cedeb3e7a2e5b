"""The losses of `reference` in NVIDIA Warp, for float32 images [H, W, 3] on CUDA; the same kernels run on a CPU, to check them.

Importing this package imports Warp. Losses stay on the device, and the host does not wait for it. All work runs on torch's
current stream in memory of torch's allocator. Results have the same bits in every run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses.images import DEVICES, image_pair
from clear_strategies.kernels.losses.reference import LossAndGradient
from clear_strategies.kernels.losses.warp import haar, similarity, sums
from rasterizers.warp_runtime import launch, on_stream

LANES: Final = {"cuda": 256, "cpu": 1}  # threads per block; on a CPU, Warp's blocks have one


def photometric(x: Tensor, y: Tensor, lambda_ssim: float, out: Tensor | None = None) -> LossAndGradient:
    """See `losses.photometric`."""
    x, y, out = image_pair(DEVICES["warp"], x, y, out)
    height, width = x.shape[0], 3 * x.shape[1]
    l1_share, dssim_share = (1 - lambda_ssim) / x.numel(), lambda_ssim / x.numel()
    with on_stream(x.device):
        if lambda_ssim == 0:
            parts = _parts(x, height)
            _launch(sums.absolute, [height], x.device, x, y, l1_share, l1_share, out, parts)
        else:
            blocks = [-(-height // similarity.ROWS), -(-width // similarity.STRIDE)]
            parts, maps = _parts(x, blocks[0] * blocks[1]), x.new_empty(similarity.MAPS, height, width)
            lanes, steps = LANES[x.device.type], (l1_share, l1_share, -dssim_share)
            _launch(similarity.similarity(lanes), blocks, x.device, x, y, dssim_share, maps, parts)
            _launch(similarity.gradient(lanes), blocks, x.device, x, y, maps, *steps, out, parts)
        return LossAndGradient(_total(parts), out)


def haar_l1(x: Tensor, y: Tensor, levels: int = 1, out: Tensor | None = None) -> LossAndGradient:
    """See `losses.haar_l1`."""
    x, y, out = image_pair(DEVICES["warp"], x, y, out)
    with on_stream(x.device):
        pyramid = [x]  # the input of each level; the first one is x - y
        for _ in range(levels - 1):
            finer = pyramid[-1]
            low = finer.new_empty(-(-finer.shape[0] // 2), -(-finer.shape[1] // 2), 3)
            launch(haar.low_part, low.shape[:2], (finer, y, finer is x, low), x.device)
            pyramid.append(low)
        rows = [-(-level.shape[0] // 2) for level in pyramid]  # of blocks
        parts, above = _parts(x, sum(rows)), None
        for level, level_parts in zip(reversed(pyramid), reversed(torch.split(parts, rows)), strict=True):
            gradient = out if level is x else torch.empty_like(level)
            weight = 1 / (9 * len(level_parts) * -(-level.shape[1] // 2) * levels)  # three details of three channels
            _launch(
                haar.details, [len(level_parts)], x.device, level, y, level is x, above, above is None, weight, gradient,
                level_parts,
            )  # fmt: skip
            above = gradient
        return LossAndGradient(_total(parts), out)


def _parts(like: Tensor, blocks: int) -> Tensor:
    return like.new_empty(blocks, dtype=torch.float64)


def _total(parts: Tensor) -> Float[Tensor, ""]:
    value = parts.new_empty((), dtype=torch.float32)
    _launch(sums.total, [1], parts.device, parts, value)
    return value


def _launch(kernel: Any, blocks: Sequence[int], device: torch.device, *arguments: Any) -> None:
    launch(kernel, blocks, arguments, device, block=LANES[device.type], together=True)
