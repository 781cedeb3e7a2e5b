"""Super-resolution in tiles, joined without seams, for images that do not fit into memory as a whole."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import require_whole
from clear_strategies.core.progress import told
from clear_strategies.errors import SettingError

_LONG: Final = 30.0  # seconds; less is told by the number of photos that are done


def tiled(
    upscale: Callable[[Float[Tensor, "h w 3"]], Float[Tensor, "H W 3"]],
    lr: Float[Tensor, "h w 3"],
    factor: int,
    tile: int,
    overlap: int,
) -> Float[Tensor, "H W 3"]:
    """Apply `upscale` to tiles of at most `tile` × `tile` LR pixels, and join the results.

    The tiles' shares partition the image. A tile contributes `overlap` LR pixels beyond its share on each side, blended
    with its neighbour, and its input reaches `overlap` further. The result equals that of the whole image if `overlap`
    is at least the network's receptive radius. It has no edges even if that is unbounded (global pooling).
    `tile` and `overlap` are as `require_tiles` allows.
    """
    height, width = lr.shape[:2]
    if max(height, width) <= tile:
        return upscale(lr)
    rows, columns = (_shares(size, tile, overlap) for size in (height, width))
    out = lr.new_zeros(height * factor, width * factor, 3)
    weight = lr.new_zeros(height * factor, width * factor, 1)
    shares = list(itertools.product(rows, columns))
    for row, column in told(shares, "super-resolution of a photo", "tiles", len(shares), _LONG):
        (rows_in, rows_out, fade_y), (columns_in, columns_out, fade_x) = (
            _along(share, size, factor, overlap) for share, size in ((row, height), (column, width))
        )
        fade = (fade_y[:, None] * fade_x)[..., None].to(lr)
        out[rows_out, columns_out] += fade * upscale(lr[rows_in, columns_in])
        weight[rows_out, columns_out] += fade
    return out / weight


def require_tiles(tile: int, overlap: int) -> None:
    """Raise a SettingError unless 0 <= 4 overlap < tile."""
    if not 0 <= 4 * overlap < tile:
        raise SettingError(
            f"prior.tile: 0 <= 4 overlap < tile must hold, got overlap={overlap}, tile={tile}: enlarge prior.tile"
        )
    require_whole("prior.tile", tile, least=1)
    require_whole("prior.overlap", overlap, least=0)


def _shares(size: int, tile: int, overlap: int) -> list[tuple[int, int]]:
    """Split [0, size) into nearly equal intervals, short enough for `2 overlap` more pixels on both sides of each."""
    count = math.ceil(size / (tile - 4 * overlap)) if size > tile else 1
    ends = [size * i // count for i in range(count + 1)]
    return list(itertools.pairwise(ends))


def _along(share: tuple[int, int], size: int, factor: int, overlap: int) -> tuple[slice, slice, Float[Tensor, " n"]]:
    """A tile's LR pixels along one axis, its HR pixels, and their weight: 1 inside its share, a ramp of 2 `overlap` at inner
    borders, then 0.
    """
    first, last = max(share[0] - 2 * overlap, 0), min(share[1] + 2 * overlap, size)
    at = torch.arange(first * factor, last * factor) + 0.5
    ramp = max(2 * overlap * factor, 1)  # without overlap: a sharp cut between two pixels
    weight = torch.ones_like(at)
    if share[0] > 0:
        weight = weight * ((at - share[0] * factor) / ramp + 0.5).clamp(0, 1)
    if share[1] < size:
        weight = weight * ((share[1] * factor - at) / ramp + 0.5).clamp(0, 1)
    return slice(first, last), slice(first * factor, last * factor), weight
