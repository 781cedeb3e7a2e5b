"""Front-to-back compositing of tile lists, and its VJP for K image cotangents in one pass.

    α_i = min(α_max, o_i exp(-½ dᵀ Σ'⁻¹ d)),   T_i = Π_{j<i} (1 - α_j),   I = Σ_i T_i α_i c_i + T_end·background

Expected depth, if the table has depths, is E = Σ_i T_i α_i z_i / Σ_i T_i α_i.

A pair with α_i < α_min is skipped; a pixel ends *before* the Gaussian that would take its transmittance below
`transmittance_min`. The work is split into batches of tiles and slabs of their lists: [B tiles, L pairs, P pixels].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from rasterizers.interface import RasterSettings
from rasterizers.reference.projection import DEPTH, MEAN, OPACITY, RGB, SHEAR
from rasterizers.reference.tiles import TileGrid, TileLists


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """What the VJP needs of a batch: its tiles, each slab's pairs with the T in front of it, and T_end."""

    tiles: Int[Tensor, " B"]
    slabs: list[tuple[Int[Tensor, "B _"], Float[Tensor, "B P"]]]
    end: Float[Tensor, "B P"]


@dataclass(frozen=True, slots=True, eq=False)
class Slab:
    """A composited slab: rows of the table, and for each pair and pixel α, T before and after it, and its weight.

    Args:
        splat: o·exp(…), before the cap and the cut-off.
        kept: 1 where the pixel has not ended, else 0; None if no pixel ends in this slab.
    """

    rows: Float[Tensor, "B L W"]
    splat: Float[Tensor, "B L P"]
    alpha: Float[Tensor, "B L P"]
    before: Float[Tensor, "B L P"]
    after: Float[Tensor, "B L P"]
    kept: Float[Tensor, "B L P"] | None

    @property
    def weights(self) -> Float[Tensor, "B L P"]:
        weights = self.alpha * self.before
        return weights if self.kept is None else weights * self.kept

    def end(self, so_far: Float[Tensor, "B P"]) -> Float[Tensor, "B P"]:
        """The final T of the pixels: the last one that was kept."""
        if self.kept is None:
            return self.after[:, -1]
        return torch.minimum(so_far, torch.where(self.kept > 0, self.after, 1.0).amin(1))


@torch.no_grad()
def blend(
    table: Float[Tensor, "M1 W"], lists: TileLists, grid: TileGrid, settings: RasterSettings, lanes: int
) -> tuple[Float[Tensor, "T P C"], Float[Tensor, "T P"], list[Pass]]:
    """Colour, expected depth and final transmittance of every pixel of every tile, and what `blend_vjp` needs."""
    n_tiles, pixels = grid.rows * grid.columns, grid.tile**2
    draws_depth = table.shape[1] == DEPTH.stop
    background = table.new_tensor((*settings.background, 0.0) if draws_depth else settings.background)
    colors = background.expand(n_tiles, pixels, -1).clone()
    transmittance = table.new_ones(n_tiles, pixels)
    passes = []
    for tiles in lists.batches(pixels, lanes):
        color, cover = table.new_zeros(len(tiles), pixels, len(background)), table.new_zeros(len(tiles), pixels)
        through = end = table.new_ones(len(tiles), pixels)  # `through` keeps falling after a pixel has ended
        slabs = []
        for pairs in lists.slabs(tiles):
            if bool((through < settings.transmittance_min).all()):
                break
            slabs.append((pairs, through))
            slab = _composite(table[pairs], tiles, grid, settings, through)
            weights = slab.weights
            color += weights.transpose(1, 2) @ slab.rows[..., RGB.start :]
            if draws_depth:
                cover += weights.sum(1)  # not 1 - T_end, which has no digits left where little is drawn
            through, end = slab.after[:, -1], slab.end(end)
        if draws_depth:
            color[..., 3] /= cover.where(cover > 0, 1.0)
        colors[tiles] = color + end[..., None] * background
        transmittance[tiles] = end
        passes.append(Pass(tiles, slabs, end))
    return colors, transmittance, passes


@torch.no_grad()
def blend_vjp(
    table: Float[Tensor, "M1 W"],
    passes: list[Pass],
    grid: TileGrid,
    settings: RasterSettings,
    cotangents: Float[Tensor, "K T P C"],
    alpha: Float[Tensor, "K T P"] | None,
    *,
    absgrad: bool = False,
) -> tuple[Float[Tensor, "K M1 W"], Float[Tensor, "K M1 2"] | None]:
    """Gradient of Σ v·image + v_α·(1 - T_end) with respect to the table, back to front, and the sums of its absolute values by
    the centre.

    With s_i = c_i·v and `behind` = Σ_{j>i} T_j α_j s_j + T_end (background·v - v_α):  ∂/∂α_i = T_i s_i - behind / (1 - α_i).

    Args:
        cotangents: v; a fourth channel is that of the accumulated depth Σ T_i α_i z_i. alpha: v_α, or None: 0.
    """
    channels = slice(RGB.start, RGB.start + cotangents.shape[-1])
    background = table.new_tensor((*settings.background, 0.0)[: cotangents.shape[-1]])
    monomials = _monomials(grid.tile, table)
    gradients = table.new_zeros(len(cotangents), *table.shape)
    absolute = table.new_zeros(len(cotangents), len(table), 2) if absgrad else None
    for batch in passes:
        v = cotangents[:, batch.tiles]
        behind = batch.end * (v @ background if alpha is None else v @ background - alpha[:, batch.tiles])
        for pairs, through in reversed(batch.slabs):
            slab = _composite(table[pairs], batch.tiles, grid, settings, through)
            weights = slab.weights
            # Where α is capped or cut to 0, the image does not depend on the ellipse.
            sensitivity = slab.alpha * _at_least(settings.alpha_max - slab.splat, 0)
            if slab.kept is not None:
                sensitivity *= slab.kept
            one_minus_alpha = 1 - slab.alpha
            for k, v_k in enumerate(v):
                s = slab.rows[..., channels] @ v_k.transpose(1, 2)
                blended = weights * s
                tail = blended.flip(1).cumsum(1).flip(1)  # includes i itself
                d_alpha = slab.before * s - (tail - blended + behind[k][:, None]) / one_minus_alpha
                q = d_alpha * sensitivity
                d_rows = _table_gradient(slab.rows, q, weights @ v_k, batch.tiles, grid, monomials)
                if absolute is not None:
                    absolute[k].index_add_(0, pairs.flatten(), _absolute(slab.rows, q, batch.tiles, grid).flatten(0, 1))
                gradients[k, :, : d_rows.shape[-1]].index_add_(0, pairs.flatten(), d_rows.flatten(0, 1))
                behind[k] += tail[:, 0]
    return gradients, absolute


def _composite(
    rows: Float[Tensor, "B L W"],
    tiles: Int[Tensor, " B"],
    grid: TileGrid,
    settings: RasterSettings,
    through: Float[Tensor, "B P"],
) -> Slab:
    dx, dy = _offsets(rows, tiles, grid)
    A, S, D = (x[..., None, None] for x in rows[..., SHEAR].unbind(-1))

    exponent = torch.addcmul(dx, S, dy).square_().mul_(-0.5 * A).sub_(0.5 * D * dy * dy)
    splat = exponent.flatten(2).exp_().mul_(rows[..., OPACITY])
    alpha = _cut_below(splat.clamp_max(settings.alpha_max), settings.alpha_min)
    after = torch.cumprod(1 - alpha, dim=1).mul_(through[:, None])
    before = torch.cat((through[:, None], after[:, :-1]), dim=1)
    ends = bool((after[:, -1] < settings.transmittance_min).any())
    kept = _at_least(after, settings.transmittance_min) if ends else None
    return Slab(rows, splat, alpha, before, after, kept)


def _offsets(
    rows: Float[Tensor, "B L W"], tiles: Int[Tensor, " B"], grid: TileGrid
) -> tuple[Float[Tensor, "B L 1 X"], Float[Tensor, "B L Y 1"]]:
    """From the centres to the pixels of the tiles."""
    u, v = rows[..., MEAN].unbind(-1)
    pixel = torch.arange(grid.tile, dtype=rows.dtype, device=rows.device) + 0.5
    dx = ((tiles % grid.columns * grid.tile)[:, None] + pixel)[:, None, None, :] - u[..., None, None]
    dy = ((tiles // grid.columns * grid.tile)[:, None] + pixel)[:, None, :, None] - v[..., None, None]
    return dx, dy


def _absolute(
    rows: Float[Tensor, "B L W"], q: Float[Tensor, "B L P"], tiles: Int[Tensor, " B"], grid: TileGrid
) -> Float[Tensor, "B L 2"]:
    """Σ|∂L/∂u| over the pixels of the tiles."""
    dx, dy = _offsets(rows, tiles, grid)
    A, S, D = (x[..., None, None] for x in rows[..., SHEAR].unbind(-1))
    along = A * (dx + S * dy)
    return torch.stack([(q * d.flatten(2)).abs().sum(-1) for d in (along, S * along + D * dy)], -1)


def _table_gradient(
    rows: Float[Tensor, "B L W"],
    q: Float[Tensor, "B L P"],
    d_channels: Float[Tensor, "B L C"],
    tiles: Int[Tensor, " B"],
    grid: TileGrid,
    monomials: Float[Tensor, "P 6"],
) -> Float[Tensor, "B L _"]:
    """The gradient of the table's rows from q = ∂L/∂(log splat) per pixel, by q's moments about the Gaussian's centre."""
    # Moments about the tile's centre first, because one matrix product then serves all tiles; then along s = x + S y, and about
    # the Gaussian's centre.
    m, mx, my, mxx, mxy, myy = (q @ monomials).unbind(-1)
    u, v = rows[..., MEAN].unbind(-1)
    A, S, D = rows[..., SHEAR].unbind(-1)
    columns, rows_of_tiles = (tiles % grid.columns).to(u.dtype), (tiles // grid.columns).to(v.dtype)
    ox = ((columns + 0.5) * grid.tile)[:, None] - u
    oy = ((rows_of_tiles + 0.5) * grid.tile)[:, None] - v
    os, ms, msy = ox + S * oy, mx + S * my, mxy + S * myy
    mss = mxx + S * (mxy + msy)
    qs, qy = ms + os * m, my + oy * m
    qss, qsy, qyy = mss + os * (ms + qs), msy + os * my + oy * qs, myy + oy * (my + qy)
    d_opacity = m / rows[..., OPACITY][..., 0].clamp_min(torch.finfo(rows.dtype).tiny)
    geometry = (A * qs, S * A * qs + D * qy, -0.5 * qss, -A * qsy, -0.5 * qyy, d_opacity)
    return torch.cat((torch.stack(geometry, dim=-1), d_channels), dim=-1)


def _monomials(tile: int, like: Tensor) -> Float[Tensor, "P 6"]:
    offset = torch.arange(tile, dtype=like.dtype, device=like.device) + 0.5 - tile / 2
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    x, y = x.flatten(), y.flatten()
    return torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y), dim=-1)


# These are ten times faster on a CPU than torch.where with a scalar.
def _cut_below(x: Tensor, limit: float) -> Tensor:
    """X where x >= limit, else 0."""
    at = torch.tensor(limit, dtype=x.dtype, device="cpu")
    return F.threshold(x, float(torch.nextafter(at, torch.full_like(at, -math.inf))), 0.0)


def _at_least(x: Tensor, limit: float) -> Tensor:
    """1 where x >= limit, else 0."""
    return (x >= limit).to(x.dtype)
