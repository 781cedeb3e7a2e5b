"""Operators on images. Every image is float [H, W, C]; photographs are in [0, 1].

D and U are defined here once, for the data sets that make LR images, for P2G's evidence and for the evaluation.
Reliability must be measured with the kernel that made LR; another kernel would measure the difference of the kernels
(reading F21 in docs/explanation/paper.md).
"""

from __future__ import annotations

from typing import Final, Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from clear_strategies.core.checks import require_choice

DownKernel = Literal["bicubic", "bilinear", "lanczos", "area"]
UpKernel = Literal["bicubic", "nearest"]

_LEAST_DIFFERENCE: Final = 1 / 255  # a smaller one is no contradiction

_PIL_FILTERS: Final = {
    "bicubic": Image.Resampling.BICUBIC,
    "bilinear": Image.Resampling.BILINEAR,
    "lanczos": Image.Resampling.LANCZOS,
}


def downsample(image: Float[Tensor, "H W 3"], factor: int, kernel: DownKernel = "bicubic") -> Float[Tensor, "h w 3"]:
    """D: reduce by a whole factor, antialiased; the result lies in [0, 1].

    "bicubic", "bilinear" and "lanczos" are PIL's resize with 8 bits per pass, as in the published protocols. "area" is
    the mean of each block, not rounded. Not differentiable.

    Raises:
        ValueError: unknown kernel, or a size that is not a multiple of `factor`.
    """
    height, width = image.shape[:2]
    if height % factor or width % factor:
        raise ValueError(f"{width}x{height} is not a multiple of {factor}; crop it first.")
    return resize(image, (width // factor, height // factor), kernel)


def resize(
    image: Float[Tensor, "H W 3"], size: tuple[int, int], kernel: DownKernel = "bicubic"
) -> Float[Tensor, "h w 3"]:
    """D to any size (width, height), by the operators of `downsample`; the result lies in [0, 1].

    Raises:
        ValueError: unknown kernel, or a size that is not positive.
    """
    require_choice("kernel", kernel, get_args(DownKernel))
    width, height = size
    if width < 1 or height < 1:
        raise ValueError(f"an image needs at least one pixel a side, got {width}x{height}.")
    if (height, width) == tuple(image.shape[:2]):
        return image.clone()
    if kernel == "area":
        if image.shape[0] % height or image.shape[1] % width:  # torch's pooling takes whole pixels alone
            return _block_means(_block_means(image, height, 0), width, 1).clamp(0, 1)
        return _hwc(F.adaptive_avg_pool2d(_nchw(image), (height, width))).clamp(0, 1)
    small = Image.fromarray(to_bytes(image)).resize((width, height), _PIL_FILTERS[kernel])
    return torch.from_numpy(np.array(small)).to(image) / 255


def _block_means(image: Float[Tensor, "H W C"], count: int, dim: int) -> Float[Tensor, "h w C"]:
    """The means of `count` equal blocks of rows (`dim` 0) or columns (1); a pixel on an edge counts by its share."""
    size = image.shape[dim]
    edges = torch.arange(count + 1, dtype=torch.float64) * size / count
    start, end = edges[:-1], edges[1:]
    means = image.new_zeros(())
    for k in range(size // count + 2):  # the most pixels that a block touches
        pixel = start.long() + k
        share = (torch.minimum(end, pixel + 1) - torch.maximum(start, pixel)).clamp_min(0) * count / size
        pixels = image.index_select(dim, pixel.clamp_max(size - 1).to(image.device))
        means = means + pixels * share.view(-1, *[1] * (2 - dim)).to(image)
    return means


def area_mean(image: Float[Tensor, "H W C"], factor: int) -> Float[Tensor, "h w C"]:
    """The mean of each factor × factor block, whatever the values."""
    return image if factor == 1 else _hwc(F.avg_pool2d(_nchw(image), factor))


def area_mean_transposed(cotangents: Float[Tensor, "K h w C"], factor: int) -> Float[Tensor, "K H W C"]:
    """The VJP of `area_mean`: each cotangent, divided equally among the pixels of its block."""
    if factor == 1:
        return cotangents
    return cotangents.repeat_interleave(factor, 1).repeat_interleave(factor, 2) / factor**2


def upsample(image: Float[Tensor, "h w C"], factor: int, kernel: UpKernel = "bicubic") -> Float[Tensor, "H W C"]:
    """U: enlarge by a whole factor, clamped to [0, 1]. "bicubic" is PIL's kernel (a = -0.5).

    Raises:
        ValueError: unknown kernel.
    """
    return _enlarged(image, factor, kernel).clamp(0, 1)


def back_projected(
    sr: Float[Tensor, "H W C"],
    lr: Float[Tensor, "h w C"],
    factor: int,
    rounds: int,
    down: DownKernel = "bicubic",
    where: Float[Tensor, "H W 1"] | float = 1.0,
) -> Float[Tensor, "H W C"]:
    """`sr` moved until it shrinks to `lr`: I ← I + U(I_LR − D(I)), iterated back-projection (Irani and Peleg, 1991).

    Args:
        rounds: how often; each leaves about half of the difference. down: D; U is bicubic.
        where: a weight of the change, e.g. 1 where it is allowed and else 0.
    """
    for _ in range(rounds):
        change = _enlarged(lr - downsample(sr, factor, down), factor, "bicubic")
        sr = change.mul_(where).add_(sr).clamp_(0, 1)
    return sr


def as_rgb(layer: Float[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """An image of three equal channels, to be resized as photos are."""
    return layer[..., None].expand(-1, -1, 3).contiguous()


def patch_means(values: Float[Tensor, "H W C"], patch: int) -> Float[Tensor, "ph pw"]:
    """Avg_p: mean over pixels and channels of each patch × patch square, aligned at the top-left.

    A partial patch at the right or bottom border is averaged over its own pixels (reading F22 in docs/explanation/paper.md).
    """
    mean = values.mean(dim=2)[None, None]
    return F.avg_pool2d(mean, patch, ceil_mode=True, count_include_pad=False)[0, 0]


def agreement(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], shown: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, "h w 1"]:
    """1 / (1 + (r / 2m)²) at each pixel, with r the mean difference of the 5 x 5 pixels around it and m the median of r: a robust
    weight, near 1 at most pixels and low where `target` shows what `image` contradicts.

    Args:
        shown: the pixels whose r have a part in m; None: all.
    """
    difference = (image - target).abs().mean(dim=2)[None, None]
    r = F.avg_pool2d(difference, 5, 1, 2, count_include_pad=False)[0, 0]
    # nan_to_num: where no pixel is shown.
    m = r.median() if shown is None else torch.where(shown, r, torch.nan).nanmedian().nan_to_num(0.0)
    return (1 / (1 + (r / (2 * m).clamp_min(_LEAST_DIFFERENCE)).square()))[..., None]


def to_bytes(image: Float[Tensor, "H W *C"]) -> np.ndarray:
    """The image as 8-bit levels, uint8 in main memory; values outside [0, 1] are clamped."""
    return np.asarray(image.detach().clamp(0, 1).mul_(255).round_().to(torch.uint8).cpu().numpy())


def quantize(image: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Round to 8 bits, as an image file would."""
    return image.clamp(0, 1).mul_(255).round_().div_(255)


def _enlarged(image: Float[Tensor, "h w C"], factor: int, kernel: UpKernel) -> Float[Tensor, "H W C"]:
    require_choice("kernel", kernel, get_args(UpKernel))
    if factor == 1:
        return image.clone()
    size = (image.shape[0] * factor, image.shape[1] * factor)
    if kernel == "nearest":
        return _hwc(F.interpolate(_nchw(image), size=size, mode="nearest"))
    # With antialias torch uses PIL's cubic kernel (a = -0.5), without it a = -0.75.
    return _hwc(F.interpolate(_nchw(image), size=size, mode=kernel, antialias=True, align_corners=False))


def _nchw(image: Float[Tensor, "H W C"]) -> Float[Tensor, "1 C H W"]:
    return image.permute(2, 0, 1)[None].contiguous()


def _hwc(batch: Float[Tensor, "1 C H W"]) -> Float[Tensor, "H W C"]:
    return batch[0].permute(1, 2, 0).contiguous()
