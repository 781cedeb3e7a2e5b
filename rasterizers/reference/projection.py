"""EWA projection of Gaussians with the 2D Mip kernel, their view-dependent colour, and the VJP of both.

Only Gaussians that can contribute (beyond the near plane, opaque enough) are projected. Determinants are sums of squared
minors of the factor T of Σ = T Tᵀ (Cauchy-Binet), which has only positive terms; `a c - b²` loses all digits for a needle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rasterizers.geometry import BLACK, REACH, basis_from, depths, rotation_matrix, tangent_limits
from rasterizers.interface import Camera, RasterSettings, SplatGradients, Splats

# Columns of the table that blending reads, one row per projected Gaussian; the last one is there if depth is drawn.
MEAN, SHEAR, OPACITY, RGB, DEPTH = slice(0, 2), slice(2, 5), slice(5, 6), slice(6, 9), slice(9, 10)


class Footprints(NamedTuple):
    """What M Gaussians cover of an image, in the order of their rows.

    Args:
        means2d: centre, px.
        shears: (A, S, D) of the exponent ½(A (dx + S dy)² + D dy²), A and D in 1/px². The expanded `conics` would lose all digits
            far along a thin Gaussian, where their terms cancel.
        deviations: standard deviations along x and y, px.
        compensation: the opacity's factor, where Mip's antialiasing is on.
    """

    means2d: Float[Tensor, "M 2"]
    depths: Float[Tensor, " M"]
    shears: Float[Tensor, "M 3"]
    deviations: Float[Tensor, "M 2"]
    compensation: Float[Tensor, " M"]

    @property
    def conics(self) -> Float[Tensor, "M 3"]:
        """(A, B, C) of the same exponent, ½(A dx² + 2B dx dy + C dy²); 1/px²."""
        A, S, D = self.shears.unbind(-1)
        return torch.stack((A, A * S, A * S * S + D), -1)

    @torch.no_grad()
    def radii(self, opacities: Float[Tensor, " M"], alpha_min: float) -> Float[Tensor, "M 2"]:
        """As `WithTraits.radii`, of Gaussians that are all visible."""
        reach = (2 * (opacities / alpha_min).log()).clamp_min(0).sqrt().clamp_max(REACH)
        return (reach[:, None] * self.deviations).ceil().clamp_min(1)


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """M of N Gaussians projected onto the image, with the autograd graph of the projection.

    Args:
        rows: which of the N splats each row is.
        opacities: after the Mip compensation.
        half_extents: half the bounding box of the region where alpha may reach alpha_min, px.
        power_max: the exponent at which alpha has fallen to alpha_min.
        leaves: copies of the splats' rows (means, quats, scales, opacities), the inputs of the graph.
        raw_rgb: colour before its clamp at 0. basis: Y of this view's directions.
        draws_depth: the table has the column of depths.
    """

    n_splats: int
    rows: Int[Tensor, " M"]
    footprints: Footprints
    opacities: Float[Tensor, " M"]
    rgb: Float[Tensor, "M 3"]
    half_extents: Float[Tensor, "M 2"]
    power_max: Float[Tensor, " M"]
    leaves: tuple[Tensor, Tensor, Tensor, Tensor]
    raw_rgb: Float[Tensor, "M 3"]
    basis: Float[Tensor, "M B1"]
    draws_depth: bool

    @property
    def _columns(self) -> list[Tensor]:
        f = self.footprints
        return [f.means2d, f.shears, self.opacities, self.rgb, *([f.depths] if self.draws_depth else [])]

    def table(self) -> Float[Tensor, "M1 W"]:
        """The columns that blending reads, plus an empty row that pads the tile lists."""
        table = torch.column_stack([x.detach() for x in self._columns])
        return torch.cat((table, table.new_zeros(1, table.shape[1])))

    def scatter(self, values: Tensor) -> Tensor:
        """The values at their rows among all N splats; zeros (or False) elsewhere."""
        out = values.new_zeros(self.n_splats, *values.shape[1:])
        out[self.rows] = values
        return out

    def vjp(
        self, table_gradients: Float[Tensor, "K M1 W"], absgrad: Float[Tensor, "K M1 2"] | None = None
    ) -> SplatGradients:
        """The splats' gradients from those of the table."""
        inputs = (*self.leaves, self.raw_rgb)
        by_cotangent = []
        for g in table_gradients[:, : self.rows.shape[0]]:
            parts = zip((MEAN, SHEAR, OPACITY, RGB, DEPTH), self._columns, strict=False)
            cotangents = [g[:, columns].reshape(x.shape) for columns, x in parts]
            gradients = torch.autograd.grad(
                self._columns, inputs, cotangents, retain_graph=True, materialize_grads=True
            )
            moved = (g != 0).any(1)  # 0 times the derivative of an ellipse far below a pixel, which overflows, is NaN
            rows = [x.where(moved.view(-1, *[1] * (x.dim() - 1)), 0) for x in gradients]
            by_cotangent.append([*rows, g[:, MEAN]])
        means, quats, scales, opacities, rgb, screen = (
            torch.stack([self.scatter(g) for g in attribute]) for attribute in zip(*by_cotangent, strict=True)
        )
        if absgrad is not None:
            absgrad = torch.stack([self.scatter(g[: self.rows.shape[0]]) for g in absgrad])
        return SplatGradients(means, quats, scales, opacities, screen, rgb, self.scatter(self.basis), absgrad)


def footprints(
    means: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    scales: Float[Tensor, "M 3"],
    camera: Camera,
    kernel: float,
) -> Footprints:
    """Σ' = J W Σ Wᵀ Jᵀ + kernel·I and u = π(μ), of Gaussians in front of the camera."""
    pose = camera.world_to_camera.to(means)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    means2d = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), dim=-1)

    # T = J W R(q) diag(s): the two rows of a 2 x 3 factor of Σ'.
    axes = pose[:3, :3] @ (rotation_matrix(quats) * scales[:, None, :])
    limits_x, limits_y = tangent_limits(camera)
    jx, jy = -camera.fx * (x / z).clamp(*limits_x), -camera.fy * (y / z).clamp(*limits_y)  # times z
    row_x = (camera.fx * axes[:, 0] + jx[:, None] * axes[:, 2]) / z[:, None]
    row_y = (camera.fy * axes[:, 1] + jy[:, None] * axes[:, 2]) / z[:, None]

    # Lengths in units of the larger of T's largest entry and √kernel, so that fourth powers neither over- nor underflow.
    # The unit cancels, so it needs no gradient.
    unit = torch.cat((row_x, row_y), dim=-1).detach().abs().amax(-1).clamp_min(math.sqrt(kernel))
    tx, ty, k = row_x / unit[:, None], row_y / unit[:, None], kernel / unit / unit
    a, b, c = (tx * tx).sum(-1), (tx * ty).sum(-1), (ty * ty).sum(-1)
    area = torch.linalg.vector_norm(torch.linalg.cross(tx, ty), dim=-1)  # √det(T Tᵀ), det = Σ minors²
    blur = k * (a + c) + k * k
    det = area * area + blur  # det Σ'
    shears = torch.stack(((c + k) / (det * unit * unit), -b / (c + k), 1 / ((c + k) * unit * unit)), dim=-1)
    deviations = torch.stack((a + k, c + k), dim=-1).sqrt() * unit[:, None]
    return Footprints(means2d, z, shears, deviations, _compensation(area, blur))


def project(splats: Splats, camera: Camera, settings: RasterSettings, *, depth: bool) -> Projection:
    """Footprints and colours of every Gaussian that can contribute."""
    rows = _candidates(splats, camera, settings)
    means, quats, scales, opacities = leaves = (
        splats.means.detach()[rows].requires_grad_(),
        splats.quats.detach()[rows].requires_grad_(),
        splats.scales.detach()[rows].requires_grad_(),
        splats.opacities.detach()[rows].requires_grad_(),
    )
    with torch.enable_grad():
        f = footprints(means, quats, scales, camera, settings.kernel)
        if settings.antialiased:
            opacities = opacities * f.compensation

        basis = basis_from(camera, means, splats.shN.shape[1])
        coefficients = torch.cat((splats.sh0.detach()[rows], splats.shN.detach()[rows]), dim=1)
        raw_rgb = (basis[:, :, None] * coefficients).sum(1) + 0.5
        if splats.rgb_offset is not None:
            raw_rgb = raw_rgb + splats.rgb_offset.detach()[rows]
        if not raw_rgb.requires_grad:
            raw_rgb.requires_grad_()  # without higher bands the colour depends on no leaf
        drawn = raw_rgb + (raw_rgb.clamp_min(0) - raw_rgb).detach()
        rgb = torch.where(raw_rgb >= -BLACK, drawn, 0)  # clamped at 0; the gradient reaches down to -BLACK

    with torch.no_grad():
        # alpha >= alpha_min  <=>  exponent <= power_max, with a margin; `blend` applies the exact cut-off per pixel.
        power_max = (opacities / settings.alpha_min).log() * (1 + 1e-3) + 1e-3
        half = torch.sqrt(2 * power_max.clamp_min(0))[:, None] * f.deviations
    return Projection(len(splats), rows, f, opacities, rgb, half, power_max, leaves, raw_rgb, basis.detach(), depth)


def _candidates(splats: Splats, camera: Camera, settings: RasterSettings) -> Int[Tensor, " M"]:
    """The Gaussians to project. The conditions say which are kept, because NaN fails each of them."""
    pose = camera.world_to_camera.to(splats.means)
    depth = depths(splats.means.detach(), pose)
    keep: Tensor = (depth > settings.near) & (splats.opacities.detach() >= settings.alpha_min)
    return torch.nonzero(keep)[:, 0]


def _compensation(area: Float[Tensor, " M"], blur: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
    """ρ = area / √(area² + blur), the opacity factor of Mip-Splatting.

    For a large footprint ρ is 1 - blur / 2 area², whose gradient would be the difference of two numbers near 1 / area;
    1 / √(1 + blur / area²) has no such difference.
    """
    large = area * area > blur
    share = blur / torch.where(large, area, 1.0).square()
    return torch.where(large, torch.rsqrt(1 + share), area * torch.rsqrt(torch.where(large, 1.0, area * area + blur)))
