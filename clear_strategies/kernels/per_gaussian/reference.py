"""The functions in torch, the specification of the kernels of the same names in `cpp` and `warp`."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import screen_norm, to_ndc
from rasterizers.geometry import rotation_matrix


def activate(
    log_scales: Float[Tensor, "N 3"],
    logits: Float[Tensor, " N"],
    filters: Float[Tensor, " N"],
    gate: Float[Tensor, " N"] | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Scales, filtered scales, σ, coefficient, factor and opacities, see `training.field.Activation`.

    Args:
        filters: standard deviations of the 3D filter. gate: zᵗ; None: 1.
    """
    scales = log_scales.exp()
    # √(s² + f²), and s itself where the squares vanish; torch's hypot takes ten times as long.
    filtered = torch.maximum(scales, (scales.square() + filters[:, None].square()).sqrt_())
    shares = scales / filtered
    # torch's product over rows of three takes twice as long.
    coefficient = shares[:, 0] * shares[:, 1] * shares[:, 2]
    sigmoid = logits.sigmoid()
    factor = coefficient if gate is None else coefficient * gate.to(coefficient)
    return scales, filtered, sigmoid, coefficient, factor, factor * sigmoid


def nearest_depths(means: Float[Tensor, "N 3"], cameras: Float[Tensor, "V 20"], near: float) -> Float[Tensor, " N"]:
    """The smallest depth beyond `near` among the cameras that see each centre; infinite where none does.

    Args:
        cameras: rows of [R | t], fx, fy, cx, cy, and the bounds of u and v, inside which a centre counts.
    """
    z_min = means.new_full((len(means),), torch.inf)
    for camera in cameras:
        pose, (fx, fy, cx, cy, u_low, u_high, v_low, v_high) = camera[:12].view(3, 4), camera[12:]
        x, y, z = (means @ pose[:, :3].T + pose[:, 3]).unbind(-1)
        u, v = fx * x / z + cx, fy * y / z + cy
        inside = (z > near) & (u >= u_low) & (u <= u_high) & (v >= v_low) & (v <= v_high)
        z_min = torch.where(inside, torch.minimum(z_min, z), z_min)
    return z_min


def evidence(
    maps: Float[Tensor, "2 ph pw"], centers: Float[Tensor, "N 2"], visible: Bool[Tensor, " N"], patch: float
) -> Evidence:
    """q_i and a_i: R and A of the patch p(u_i) that contains each projected centre.  Eq. 10

    A centre outside the image has the border patch, an invisible Gaussian 0 (F24).

    Args:
        centers: u_i in pixels of the image that the patches tile; of invisible Gaussians anything, since gsplat leaves their
            rows uninitialised. patch: edge of a patch in those pixels.
    """
    # Of NaN or infinity it is any number, which the clamps bring inside. In 32 bits it takes two thirds of the time of 64.
    column, row = (centers / patch).to(torch.int32).unbind(-1)
    height, width = maps.shape[1:]
    at = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    return Evidence(*(maps.flatten(1).index_select(1, at) * visible))  # Eq. 10


def route(e: Evidence, visible: Bool[Tensor, " N"], floor: float, normalize: bool) -> Float[Tensor, " N"]:
    """m_i, over its mean where `normalize`; undefined for invisible Gaussians.  Eq. 12"""
    m = floor + (1 - floor) * e.weight  # Eq. 12
    if not normalize:
        return m
    mean = (m * visible).sum() / visible.sum().clamp_min(1)
    return m / mean.clamp_min(torch.finfo(m.dtype).tiny)


def screens(
    lr: Float[Tensor, "N 2"],
    base: Float[Tensor, "N 2"],
    hf: Float[Tensor, "N 2"] | None,
    size: tuple[int, int],
    weights: tuple[float, float] | Float[Tensor, " 2"],
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 2"] | None, Float[Tensor, " N"]]:
    """∇_u of the two HR losses in NDC, and the ordinary statistic, see `ScreenGradients`.

    Args:
        lr: in NDC. base, hf: 1/pixel of an image of `size`. weights: λ_HR and λ_HR λ_HF, as numbers or on the device.
    """
    λ, λ_hf = weights
    base = to_ndc(base, size)
    total = lr + λ * base
    if hf is not None:
        hf = to_ndc(hf, size)
        total = total + λ_hf * hf
    return base, hf, screen_norm(total)


def evidence_score(
    e: Evidence, hf: Float[Tensor, "N 2"], ordinary: Float[Tensor, " N"], joined: bool
) -> Float[Tensor, " N"]:
    """S_i, alone or joined with the ordinary statistic at equal mean.  Eq. 14"""
    S = e.weight * screen_norm(hf)  # Eq. 14
    return ordinary + S * (ordinary.mean() / S.mean().clamp_min(torch.finfo(S.dtype).tiny)) if joined else S


def accumulate(
    visible: Bool[Tensor, " N"],
    score: Float[Tensor, " N"],
    ordinary: Float[Tensor, " N"],
    totals: tuple[Tensor, Tensor, Tensor],
    largest: bool,
) -> None:
    """Add the statistics of the visible Gaussians to `totals`, of score, ordinary and their number.

    Args:
        largest: keep the largest score and ordinary in place of their sums.
    """
    seen = visible.to(totals[2])
    for total, value in zip(totals, (score, ordinary), strict=False):
        if largest:
            torch.maximum(total, torch.where(visible, value, total), out=total)
        else:
            total.addcmul_(value, seen)
    totals[2].add_(seen)


def wander(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    gate: Float[Tensor, " N"],
    rows: Int[Tensor, " K"],
    eta: Float[Tensor, "K 3"],
    strength: float,
) -> None:
    """Move these rows of the means by strength · gate · Σ η / s̃, see `density.mcmc.MCMC`."""
    R = rotation_matrix(quats[rows])
    along = log_scales[rows].exp().square()[..., None] * (R.mT @ eta[..., None])  # S² Rᵀ η
    share = strength / log_scales.amax(-1).median().exp()
    means.index_add_(0, rows, (share * gate[rows])[:, None] * (R @ along)[..., 0])
