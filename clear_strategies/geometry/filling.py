"""Densification of a cloud: points at depths that are completed from known ones.

On a plane, inverse depth is linear in the pixels: its second differences are 0 there, and large where a surface ends, which is
mostly where colours change. The completed inverse depth u minimises, with d what is known of it,

    Σ c ρ(u − d)  +  Σ e |∂xx u|, |∂yy u|, |∂xy u|  +  3·10⁻³ Σ e (∂x u)², (∂y u)²,      e = exp(−|colour difference| / 0.025)

where ρ (Geman and McClure 1985) ignores outliers and the last term keeps planes from being continued far.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.core.progress import told
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.photos import each_photo, is_background
from clear_strategies.geometry.projection import back_project, sample_colors, seen_pixels, slopes
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

STRIDE: Final = 2
"""LR px between the points of a grid, by default."""

_FEWEST_SAMPLES: Final = 4  # least number of pixels of known depth from which a view's depth is completed
_OF_POINTS: Final = 0.3  # confidence of a point that projects into a photo, but may be occluded; stereo's depth has 1
_MAX_PIXELS: Final = 16_000  # larger photos are reduced first: 0.5 s of CPU time each
_BEYOND: Final = 2.0  # largest factor by which completed depths exceed the range of known ones
_NEARER: Final = 0.95  # share of another photo's depth, in front of which a point floats in free space
_EDGE: Final = 0.025  # difference of colours in [0, 1] at which smoothness is weakened e-fold
_LEVEL: Final = 3e-3  # weight of the first differences
_BEND: Final = 0.01  # second difference, in medians of d, from which the penalty is linear instead of quadratic
_OUTLIER: Final = 0.05  # distance from d, in medians of d, at which ρ' begins to fall
_HELD: Final = 1e-9  # weight of the median of d, where no other term applies
_ROUNDS: Final = 6  # of reweighted least squares


def densify(cloud: PointCloud, photos: Sequence[Photo], stride: int, background: Color | None = None) -> PointCloud:
    """Add `grid_points` to the cloud."""
    means, colors = grid_points(cloud.means, photos, stride, background)
    if len(means) == 0:
        _log.warning("densify added no point.")
        return cloud
    means, colors = torch.cat((cloud.means, means)), torch.cat((cloud.colors, colors))
    source = f"{cloud.source}, densified by {len(means) - len(cloud):,} at completed depth"
    return replace(cloud, means=means, colors=colors, source=source)


def grid_points(
    means: Float[Tensor, "N 3"],
    photos: Sequence[Photo],
    stride: int,
    background: Color | None = None,
    maps: Sequence[DepthMap] | None = None,
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """(positions, colours) of a point every `stride` shown pixels of each photo, at depth completed from `means` and `maps`.

    Args:
        background: pixels of this colour show no surface and get no point.
        maps: of each photo. Pixels of known depth get no point, nor do those whose point would float in front of another photo's
            known depth. None: no depth is known.
    """

    def points_in(i: int) -> tuple[Tensor, Tensor]:
        photo, depth_map = photos[i], None if maps is None else maps[i]
        grid, shade = _pixels_to_fill(photo, depth_map, stride, background)
        inverse_depth = _completed(means, photo, grid, 2 * stride, depth_map) if len(grid) else None
        if inverse_depth is None:
            return torch.zeros(0, 3), torch.zeros(0, 3)
        points = back_project(photo.camera, grid, 1 / inverse_depth)
        kept = torch.ones(len(points), dtype=torch.bool)
        for j, other in enumerate(maps or ()):
            if j != i:
                inside, row, column, depth = seen_pixels(photos[j].camera, points)
                kept[inside] &= ~(depth < _NEARER * other.depth.cpu()[row, column].double())  # True where it is unknown
        return points[kept], shade[kept]

    added = told(each_photo(points_in, photos), "depth where stereo finds none", "photos", len(photos))
    points, colors = map(torch.cat, zip((torch.zeros(0, 3), torch.zeros(0, 3)), *added, strict=True))
    return points, colors


def _pixels_to_fill(
    photo: Photo, depth_map: DepthMap | None, stride: int, background: Color | None
) -> tuple[Float[Tensor, "G 2"], Float[Tensor, "G 3"]]:
    """The grid's shown pixels of unknown depth that are not of the background's colour, and their colours."""
    grid = pixel_grid(photo, stride)
    x, y = grid.long().unbind(dim=1)
    wanted = photo.visible.cpu()
    if depth_map is not None:
        wanted = wanted & ~depth_map.known.cpu()
    grid = grid[wanted[y, x]]
    colors = sample_colors(photo, grid)
    if background is None:
        return grid, colors
    surface = ~is_background(colors, background)
    return grid[surface], colors[surface]


def pixel_grid(photo: Photo, stride: int) -> Float[Tensor, "G 2"]:
    """The centres of the image's squares of `stride` pixels, (column, row)."""
    x = torch.arange(stride / 2, photo.camera.width, stride, dtype=torch.float64)
    y = torch.arange(stride / 2, photo.camera.height, stride, dtype=torch.float64)
    return torch.cartesian_prod(x, y)


def _completed(
    means: Float[Tensor, "N 3"], photo: Photo, at: Float[Tensor, "G 2"], cell: int, depth_map: DepthMap | None
) -> Float[Tensor, " G"] | None:
    """Complete the inverse depth at these pixels, from the photo's own depth and the points; None if fewer than 4 are known.

    Occluded points would distort the depth, so only the nearest point per square of `cell` pixels is used.
    """
    factor = photo.factor_to(_MAX_PIXELS)
    small = photo.reduced(factor)
    width, height = small.camera.width, small.camera.height
    _, row, column, depth = seen_pixels(small.camera, means)
    order = torch.argsort(depth, stable=True)
    side = max(1, cell // factor)
    square = row[order] // side * width + column[order] // side
    _, first = np.unique(square.numpy(), return_index=True)
    nearest = order[torch.from_numpy(first)]
    known = torch.full((height, width), torch.nan, dtype=torch.float64)
    confidence = torch.full_like(known, _OF_POINTS)
    known[row[nearest], column[nearest]] = 1 / depth[nearest]
    if depth_map is not None:
        own = depth_map.to("cpu").reduced(factor)
        known[own.known], confidence[own.known] = 1 / own.depth[own.known].double(), 1.0
    finite = known[known.isfinite()]
    if len(finite) < _FEWEST_SAMPLES:
        _log.warning("depth of a view cannot be completed: only %d points project into it.", len(finite))
        return None
    inverse_depth = _between(completed(known, confidence, small.image), at / factor)
    return inverse_depth.clamp(finite.min() / _BEYOND, finite.max() * _BEYOND)


def _between(values: Float[Tensor, "h w"], at: Float[Tensor, "G 2"]) -> Float[Tensor, " G"]:
    """The values at these places (column, row) between the pixels' centres: that of the pixel, continued by its `slopes`."""
    column, row = (x.long().clamp(max=n - 1) for x, n in zip(at.T, reversed(values.shape), strict=True))
    result = values[row, column]
    for axis, pixel, place in ((1, column, at[:, 0]), (0, row, at[:, 1])):
        result = result + slopes(values, axis)[row, column] * (place - pixel - 0.5)
    return result


def completed(
    known: Float[Tensor, "h w"], confidence: Float[Tensor, "h w"], image: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w"]:
    """Complete the inverse depth at every pixel, float64; far from known pixels it may be 0 or less.

    Args:
        known: inverse depth d > 0, NaN where unknown; at least one pixel is known.
        confidence: c ≥ 0 of the known pixels.
        image: the photo, in [0, 1].
    """
    d, c = known.double().cpu().numpy().ravel(), confidence.double().cpu().numpy().ravel()
    is_known = np.isfinite(d)
    scale = np.median(d[is_known])
    level, bends = _smoothness(image.double().cpu().numpy())
    u = _minimiser(np.where(is_known, d / scale, 0.0), np.where(is_known, c, 0.0), level, bends)
    return torch.from_numpy((scale * u).reshape(known.shape))


def _smoothness(colors: np.ndarray) -> tuple[Any, list[tuple[Any, np.ndarray]]]:
    """The matrix of the quadratic terms of u, 3·10⁻³ Σ e ∂ᵀ∂ and `_HELD`; and (∂∂, e) of ∂xx, ∂yy and ∂xy."""
    import scipy.sparse as sp

    def difference(n: int) -> Any:
        identity = sp.eye(n, format="csr")
        return identity[1:] - identity[:-1]

    h, w, _ = colors.shape
    across, down = (np.exp(-np.abs(np.diff(colors, axis=axis)).mean(-1) / _EDGE) for axis in (1, 0))
    dx, dy = sp.kron(sp.eye(h), difference(w)), sp.kron(difference(h), sp.eye(w))
    dxx, dyy = sp.kron(sp.eye(h), difference(w - 1)) @ dx, sp.kron(difference(h - 1), sp.eye(w)) @ dy
    dxy = sp.kron(difference(h), difference(w))
    level = sum(_LEVEL * D.T @ sp.diags(e.ravel()) @ D for D, e in ((dx, across), (dy, down))) + _HELD * sp.eye(h * w)
    along_xy = np.minimum(np.minimum(across[1:], across[:-1]), np.minimum(down[:, 1:], down[:, :-1]))
    return level, [
        (dxx, np.minimum(across[:, 1:], across[:, :-1]).ravel()),
        (dyy, np.minimum(down[1:], down[:-1]).ravel()),
        (dxy, along_xy.ravel()),
    ]


def _minimiser(d: np.ndarray, c: np.ndarray, level: Any, bends: list[tuple[Any, np.ndarray]]) -> np.ndarray:
    """The minimum u, by iteratively reweighted least squares; d in units of its median."""
    import scipy.sparse as sp
    from scipy.sparse.linalg import splu

    residuals, curvatures = np.zeros(len(d)), [np.zeros(len(e)) for _, e in bends]
    for _ in range(_ROUNDS):
        trust = c / (1 + (residuals / _OUTLIER) ** 2) ** 2  # c ρ'(u − d) / (u − d)
        H = sp.diags(trust) + level
        for (D, e), curvature in zip(bends, curvatures, strict=True):
            H += D.T @ sp.diags(e / np.hypot(curvature / _BEND, 1)) @ D
        solver = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        u = solver.solve(trust * d + _HELD)
        residuals, curvatures = u - d, [D @ u for D, _ in bends]
    return u
