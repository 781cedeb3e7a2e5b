"""The lists of Gaussians that may touch each tile, front to back.

The lists may hold too many pairs, which only costs time; `blend` decides per pixel. Equal depths keep the order of their
indices (stable sorts).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rasterizers.reference.projection import Projection

_SLAB: Final = 64  # pairs of a tile that are blended at a time; opaque tiles stop between slabs


@dataclass(frozen=True, slots=True)
class TileGrid:
    """An image divided into squares of `tile` pixels; the last row and column may extend beyond it."""

    width: int
    height: int
    tile: int

    @property
    def columns(self) -> int:
        return -(-self.width // self.tile)

    @property
    def rows(self) -> int:
        return -(-self.height // self.tile)

    def to_image(self, tiles: Float[Tensor, "T P C"]) -> Float[Tensor, "H W C"]:
        t, channels = self.tile, tiles.shape[-1]
        image = tiles.view(self.rows, self.columns, t, t, channels).transpose(1, 2)
        image = image.reshape(self.rows * t, self.columns * t, channels)
        return image[: self.height, : self.width].contiguous()

    def to_tiles(self, image: Float[Tensor, "H W C"]) -> Float[Tensor, "T P C"]:
        t, channels = self.tile, image.shape[-1]
        padded = image.new_zeros(self.rows * t, self.columns * t, channels)
        padded[: self.height, : self.width] = image
        tiles = padded.view(self.rows, t, self.columns, t, channels).transpose(1, 2)
        return tiles.reshape(self.rows * self.columns, t * t, channels)


@dataclass(frozen=True, slots=True, eq=False)
class TileLists:
    """(tile, Gaussian) pairs sorted by tile, then depth, then index.

    Args:
        gaussians: row of the projection table of each pair.
        starts, lengths: the pairs of tile i are `gaussians[starts[i] : starts[i] + lengths[i]]`.
        visible: rows that may touch at least one tile of the image, requested or not.
    """

    gaussians: Int[Tensor, " pairs"]
    starts: Int[Tensor, " T"]
    lengths: Int[Tensor, " T"]
    visible: Bool[Tensor, " M"]

    def batches(self, lanes_per_pair: int, lanes: int) -> list[Int[Tensor, " _"]]:
        """The non-empty tiles in batches of at most `lanes` lanes per slab, sorted by the length of their lists."""
        order = torch.argsort(self.lengths, descending=True, stable=True)
        order = order[: int((self.lengths > 0).sum())]
        per_batch = max(1, lanes // (lanes_per_pair * _SLAB))
        return list(torch.split(order, per_batch)) if len(order) else []

    def slabs(self, tiles: Int[Tensor, " B"]) -> list[Int[Tensor, "B _"]]:
        """The lists of some tiles, stacked and split into slabs; short lists are padded with the table's empty row."""
        position = torch.arange(int(self.lengths[tiles].max()), device=tiles.device)[None]
        inside = position < self.lengths[tiles, None]
        pairs = torch.where(inside, self.starts[tiles, None] + position, 0)
        return list(torch.split(torch.where(inside, self.gaussians[pairs], len(self.visible)), _SLAB, 1))


@torch.no_grad()
def list_tiles(projection: Projection, grid: TileGrid) -> TileLists:
    """Pair each projected Gaussian with the tiles its ellipse of alpha >= alpha_min may reach."""
    n_tiles = grid.rows * grid.columns
    rows = torch.argsort(projection.footprints.depths, stable=True)
    means, half = projection.footprints.means2d.detach()[rows], projection.half_extents[rows]
    first, last = _tile_range(means - half, grid), _tile_range(means + half, grid)
    spans = (last - first + 1).clamp_min(0)
    inside = ((means + half > 0) & (means - half < means.new_tensor((grid.width, grid.height)))).all(-1)
    touches = (projection.power_max[rows] > 0) & inside
    counts = torch.where(touches, spans[:, 0] * spans[:, 1], 0)

    # Expand Gaussian by Gaussian, in depth order: pair j is the k-th tile of its Gaussian's box.
    owner = torch.repeat_interleave(torch.arange(len(rows), device=rows.device), counts)
    k = torch.arange(len(owner), device=rows.device) - (counts.cumsum(0) - counts)[owner]
    tile_x = first[owner, 0] + k % spans[owner, 0].clamp_min(1)
    tile_y = first[owner, 1] + k // spans[owner, 0].clamp_min(1)
    reached = _ellipse_reaches(projection, rows[owner], tile_x, tile_y, grid)
    owner, tile = owner[reached], (tile_y * grid.columns + tile_x)[reached]

    visible = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
    visible[rows[owner]] = True

    by_tile = torch.argsort(tile, stable=True)  # keeps the depth order within each tile
    lengths = torch.bincount(tile, minlength=n_tiles)
    return TileLists(rows[owner[by_tile]], lengths.cumsum(0) - lengths, lengths, visible)


def _tile_range(corner: Float[Tensor, "M 2"], grid: TileGrid) -> Int[Tensor, "M 2"]:
    limit = corner.new_tensor((grid.columns - 1, grid.rows - 1))
    # Clamped as float, because a huge splat's corner does not fit an integer.
    return (corner / grid.tile).floor().clamp(min=torch.zeros_like(limit), max=limit).long()


def _ellipse_reaches(
    projection: Projection, row: Tensor, tile_x: Tensor, tile_y: Tensor, grid: TileGrid
) -> Bool[Tensor, " pairs"]:
    """Whether the smallest exponent over the box of a tile's pixel centres is at most power_max; exact.

    A convex quadratic has its minimum over a box at its centre if that is inside, else on one of the (at most two) sides
    that face the centre; on a side it is at the clamped vertex of a parabola.
    """
    u, v = projection.footprints.means2d.detach()[row].unbind(-1)
    A, S, D = projection.footprints.shears.detach()[row].unbind(-1)
    left, top = tile_x * grid.tile + 0.5 - u, tile_y * grid.tile + 0.5 - v
    # The tiles of the last column and row may extend beyond the image, where there are no pixels.
    right = torch.minimum(left + grid.tile - 1, grid.width - 0.5 - u)
    bottom = torch.minimum(top + grid.tile - 1, grid.height - 0.5 - v)
    near_x, near_y = _nearest_to_zero(left, right), _nearest_to_zero(top, bottom)
    on_side_x = torch.clamp(-A * S * near_x / (A * S * S + D), top, bottom)
    on_side_y = torch.clamp(-S * near_y, left, right)
    power = torch.minimum(_power(A, S, D, near_x, on_side_x), _power(A, S, D, on_side_y, near_y))
    return power <= projection.power_max[row]


def _nearest_to_zero(low: Tensor, high: Tensor) -> Tensor:
    return torch.clamp(torch.zeros_like(low), low, high)


def _power(A: Tensor, S: Tensor, D: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    return 0.5 * (A * (dx + S * dy).square() + D * dy * dy)
