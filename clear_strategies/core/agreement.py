"""Which detail of an SR image other views' SR images show too, at the place that the depth says.

A detail that a prior invents shrinks back to the same LR pixels, so the LR photo cannot tell it from a real one. Another
photo's SR image can: an invention is seldom made twice at one place of the scene. The steps, for two views:

1. Each HR pixel goes to the other view by its depth; where that view knows another depth there, the surface is hidden.
2. Depth from LR photos is not exact to an HR pixel. Blocks of 4x4 LR pixels are therefore aligned: of the positions up to one
   LR pixel away along the epipolar line, the one counts where the SR images correlate best.
3. The agreement of a block is 2 cov(a, b) / (var a + var b) of the detail, in [-1, 1]; unlike a correlation it falls where
   one of the two is stronger. It counts only where the LR photos, which are authentic, correlate at the same place: where
   these do not, the depth is wrong or the surface looks different, and the detail is no evidence.

The best of the other views counts: in the worse ones the surface may be hidden, or the detail invented.
docs/explanation/agreement.md has the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel, UpKernel
from clear_strategies.core.projection import towards
from clear_strategies.core.view import View

_BLOCK: Final = 4  # LR px
_OTHERS: Final = 4  # other views with which one view is compared at most
_SAME_SURFACE: Final = 0.05  # relative difference of depth
_SEEN: Final = 0.5  # share of a block's pixels that the other view must show
_LR_CORRELATION: Final = 0.6  # of the LR photos, above which a block counts
_FAINTEST: Final = (1 / 255) ** 2  # variance of the detail: below it a block is flat, its detail rounding
_KNOWN: Final = 0.25  # share of a patch's area that must be compared
_CHANCE: Final = 0.2  # agreement of unrelated detail, the best of all positions
_RIGHT: Final = 0.8  # quantile of the patches' agreement that counts as full reliability
_TINY: Final = 1e-12
_TELLS: Final = 0.1  # that quantile must exceed chance by this, or the views do not confirm each other at all


@dataclass(frozen=True, slots=True, eq=False)
class ViewAgreement:
    """How far other views confirm the detail of one view's SR image.

    Args:
        reliability: per patch, in [0, 1]: 0 for chance, 1 for what the best fifth of the scene's patches reaches. Unknown
            patches have the mean of those that are known, so that they are neither favoured nor punished.
        known: whether another view shows enough of the patch.
    """

    reliability: Float[Tensor, "ph pw"]
    known: Bool[Tensor, "ph pw"]


def compare_views(
    views: Sequence[View], patch: int, down: DownKernel = "bicubic", up: UpKernel = "bicubic"
) -> dict[str, ViewAgreement]:
    """The agreement of each view's SR image with the others', by the views' names.

    Views without depth, or without a patch that another view shows, are missing in the result.

    Args:
        patch: edge of a patch, LR px. down, up: D and U.
    """
    bands = [_bands(view, down, up) for view in views]
    depths = [filled_inverse_depth(view) for view in views]
    raw: dict[str, tuple[Tensor, Tensor]] = {}
    for i, (view, inverse_depth) in enumerate(zip(views, depths, strict=True)):
        if inverse_depth is None:
            continue
        blocks = [_compare(view, bands[i], views[j], bands[j], inverse_depth) for j in _others(views, i, inverse_depth)]
        if blocks:
            raw[view.name] = _per_patch(torch.stack(blocks).amax(dim=0), view, patch)
    confirmed = [agreement[known] for agreement, known in raw.values()]
    if not confirmed or not len(everything := torch.cat(confirmed)):
        return {}
    right = float(torch.quantile(everything, _RIGHT))
    if right < _CHANCE + _TELLS:
        return {}
    found = {}
    for name, (agreement, known) in raw.items():
        if bool(known.any()):
            R = ((agreement - _CHANCE) / (right - _CHANCE)).clamp(0, 1)
            found[name] = ViewAgreement(torch.where(known, R, R[known].mean()), known)
    return found


def filled_inverse_depth(view: View) -> Float[Tensor, "h w"] | None:
    """1 / depth at each LR pixel, interpolated where it is unknown; None where the view has no depth."""
    if view.depth is None or not bool(view.depth.known.any()):
        return None
    known = view.depth.known
    return _filled(torch.where(known, 1 / view.depth.depth, 0.0), known.to(view.depth.depth))


def _filled(total: Float[Tensor, "h w"], weight: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Total over weight, and where the weight is 0 the same of an image of half the size, enlarged."""
    own = total / weight.clamp_min(torch.finfo(total.dtype).tiny)
    if bool((weight > 0).all()):
        return own
    halves = F.avg_pool2d(torch.stack((total, weight))[None], 2, ceil_mode=True)[0]
    coarse = F.interpolate(_filled(*halves)[None, None], size=tuple(own.shape), mode="bilinear", align_corners=False)
    return torch.where(weight > 0, own, coarse[0, 0])


def _bands(view: View, down: DownKernel, up: UpKernel) -> Float[Tensor, "2 H W"]:
    """Two bands of a view at HR, grey: the detail, which LR cannot show, and the highest frequencies of the LR photo."""
    hr, lr, factor = view.hr.image, view.lr.image, view.factor
    detail = hr - images.upsample(images.downsample(hr, factor, down), factor, up)
    blurred = F.avg_pool2d(lr.permute(2, 0, 1)[None], 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 0)
    photo = images.upsample(lr, factor) - images.upsample(blurred, factor)
    return torch.stack((detail.mean(dim=-1), photo.mean(dim=-1)))


@dataclass(frozen=True, slots=True, eq=False)
class _Passage:
    """Where the pixels of a view lie in another, at `scale` pixels per LR pixel.

    Args:
        uv: columns and rows in the other image. along: unit vector in which they move with depth.
        visible: whether the other view shows the same surface there.
    """

    uv: Float[Tensor, "H W 2"]
    along: Float[Tensor, "H W 2"]
    visible: Bool[Tensor, "H W"]

    @classmethod
    def between(cls, view: View, other: View, inverse_depth: Float[Tensor, "h w"], scale: int) -> _Passage:
        camera, target = (v.lr.camera.scaled(scale) for v in (view, other))
        rays, shift = (x.to(inverse_depth) for x in towards(camera, target))
        d = F.interpolate(inverse_depth[None, None], scale_factor=scale, mode="bilinear", align_corners=False)[0, 0]
        d = d[: rays.shape[0], : rays.shape[1], None]
        uv, z = _divided(rays + d * shift)
        step = _divided(rays + 1.01 * d * shift)[0] - uv
        along = step / torch.linalg.vector_norm(step, dim=-1, keepdim=True).clamp_min(1e-6)
        size = uv.new_tensor([target.width, target.height])
        visible = (z > 0) & ((uv >= 0) & (uv < size)).all(dim=-1)
        if other.depth is not None:
            column, row = (uv / scale).long().clamp_min(0).unbind(dim=-1)
            height, width = other.depth.depth.shape
            there = other.depth.depth[row.clamp_max(height - 1), column.clamp_max(width - 1)]
            # nan, an unknown depth, hides nothing.
            visible &= ~((z / d[..., 0] / there - 1).abs() > _SAME_SURFACE)
        return cls(uv, along, visible)


def _divided(points: Float[Tensor, "H W 3"]) -> tuple[Float[Tensor, "H W 2"], Float[Tensor, "H W"]]:
    z = points[..., 2]
    return points[..., :2] / z.clamp_min(1e-6)[..., None], z


def _others(views: Sequence[View], i: int, inverse_depth: Float[Tensor, "h w"]) -> list[int]:
    """The views that show most of view i, at most `_OTHERS`."""
    shares = {
        j: _Passage.between(views[i], other, inverse_depth, 1).visible.double().mean().item()
        for j, other in enumerate(views)
        if j != i and other.factor == views[i].factor
    }
    return sorted((j for j in shares if shares[j] > 0), key=lambda j: (-shares[j], j))[:_OTHERS]


def _compare(
    view: View,
    mine: Float[Tensor, "2 H W"],
    other: View,
    theirs: Float[Tensor, "2 H W"],
    inverse_depth: Float[Tensor, "h w"],
) -> Float[Tensor, "bh bw"]:
    """The agreement of each block's detail at the position where the SR images correlate best; -inf where it does not count."""
    passage = _Passage.between(view, other, inverse_depth, view.factor)
    steps = range(-view.factor, view.factor + 1)
    found = [
        _blocks(mine, _drawn(theirs, passage.uv + step * passage.along), passage.visible, _BLOCK * view.factor)
        for step in steps
    ]
    correlation, agreement = (torch.stack(values) for values in zip(*found, strict=True))
    return agreement.gather(0, correlation.argmax(dim=0, keepdim=True))[0]


def _drawn(bands: Float[Tensor, "2 H W"], uv: Float[Tensor, "h w 2"]) -> Float[Tensor, "2 h w"]:
    """The bands at these columns and rows, bicubic: a bilinear kernel would blur the detail."""
    size = uv.new_tensor([bands.shape[2], bands.shape[1]])
    return F.grid_sample(bands[None], (2 * uv / size - 1)[None], "bicubic", "border", align_corners=False)[0]


def _blocks(
    a: Float[Tensor, "2 H W"], b: Float[Tensor, "2 H W"], visible: Bool[Tensor, "H W"], edge: int
) -> tuple[Float[Tensor, "bh bw"], Float[Tensor, "bh bw"]]:
    """(correlation of the SR images' high frequencies, agreement of their detail) in each block's visible pixels.

    The agreement is -inf in blocks that do not count.
    """
    weight = visible.to(a)[None]
    # The sum of the bands has all the frequencies that help to align; the LR photo alone aligns less well.
    a, b = (torch.cat((x, x.sum(0, keepdim=True))) * weight for x in (a, b))

    def mean(values: Tensor) -> Tensor:
        return F.avg_pool2d(values[None], edge, ceil_mode=True, count_include_pad=False)[0]

    share = mean(weight)
    n = share.clamp_min(1e-6)
    mean_a, mean_b = mean(a) / n, mean(b) / n
    covariance = mean(a * b) / n - mean_a * mean_b
    variance_a, variance_b = ((mean(x * x) / n - m * m).clamp_min(0) for x, m in ((a, mean_a), (b, mean_b)))
    correlation = covariance / (variance_a * variance_b).sqrt().clamp_min(_TINY)
    spread = variance_a[0] + variance_b[0]
    counts = (share[0] > _SEEN) & (correlation[1] > _LR_CORRELATION) & (spread > 2 * _FAINTEST)
    return correlation[2], torch.where(counts, 2 * covariance[0] / spread.clamp_min(_TINY), -torch.inf)


def _per_patch(
    blocks: Float[Tensor, "bh bw"], view: View, patch: int
) -> tuple[Float[Tensor, "ph pw"], Bool[Tensor, "ph pw"]]:
    """(the mean agreement of each patch's blocks, whether enough of them count)."""
    height, width = view.lr.camera.height, view.lr.camera.width
    counts = blocks.isfinite()
    on_pixels = torch.stack((blocks.where(counts, 0.0), counts.to(blocks))).repeat_interleave(_BLOCK, 1)
    on_pixels = on_pixels.repeat_interleave(_BLOCK, 2)[:, :height, :width]
    total, share = (images.patch_means(values[..., None], patch) for values in on_pixels)
    return total / share.clamp_min(_TINY), share >= _KNOWN
