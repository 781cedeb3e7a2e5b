"""Launches the kernels in order, and allocates the memory between them. Gradients are written to `images.gradient`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.kernels.losses.images import ImagePair
from clear_strategies.kernels.losses.warp import haar, similarity, sums
from rasterizers.warp_runtime import launch, on_stream

LANES: Final = {"cuda": 256, "cpu": 1}  # threads per block; on a CPU, Warp's blocks have one


def photometric(images: ImagePair, l1: float, dssim: float) -> Float[Tensor, ""]:
    """The value l1 · mean |x - y| + dssim · (1 - SSIM); with dssim = 0 no SSIM is computed."""
    x, y, out = images
    height, width = x.shape[0], 3 * x.shape[1]
    l1_share, dssim_share = l1 / x.numel(), dssim / x.numel()
    with on_stream(x.device):
        if dssim == 0:
            parts = _parts(x, height)
            _launch(sums.absolute, [height], x.device, x, y, l1_share, l1_share, out, parts)
        else:
            blocks = [-(-height // similarity.ROWS), -(-width // similarity.STRIDE)]
            parts, maps = _parts(x, blocks[0] * blocks[1]), x.new_empty(similarity.MAPS, height, width)
            _launch(similarity.similarity, blocks, x.device, x, y, dssim_share, maps, parts)
            _launch(similarity.gradient, blocks, x.device, x, y, maps, l1_share, l1_share, -dssim_share, out, parts)
        return _total(parts)


def haar_l1(images: ImagePair, levels: int) -> Float[Tensor, ""]:
    """The mean |detail| of each level, averaged over the levels."""
    x, y, out = images
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
        return _total(parts)


def _parts(like: Tensor, blocks: int) -> Tensor:
    return like.new_empty(blocks, dtype=torch.float64)


def _total(parts: Tensor) -> Float[Tensor, ""]:
    value = parts.new_empty((), dtype=torch.float32)
    _launch(sums.total, [1], parts.device, parts, value)
    return value


def _launch(kernel: Any, blocks: Sequence[int], device: torch.device, *arguments: Any) -> None:
    """Launch a kernel; `kernel` makes it for a number of threads per block."""
    lanes = LANES[device.type]
    launch(kernel(lanes), blocks, arguments, device, block=lanes, together=True)
