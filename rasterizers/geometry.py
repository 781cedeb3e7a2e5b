"""Conventions that all backends share: rotations from quaternions, spherical harmonics, and where the Jacobian is clamped."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import Camera

SH_C0: Final = 0.28209479177387814
"""The constant band: rgb = SH_C0 · sh0 + 1/2."""

BLACK: Final = 1e-6
"""A colour of 0 may come out this much below 0 by rounding. It is drawn as 0, but has a gradient, or it could never learn."""

REACH: Final = 3.33
"""Standard deviations, at most, from the centre of a Gaussian to the side of its box. gsplat's."""


def rotation_matrix(quats: Float[Tensor, "M 4"]) -> Float[Tensor, "M 3 3"]:
    """Rotation matrices of quaternions (wxyz, any norm); the zero quaternion gives the identity and zero gradient."""
    largest = quats.detach().abs().amax(-1, keepdim=True)
    identity = torch.zeros_like(quats)
    identity[:, 0] = 1
    # Divided by the largest component first, so that |q|² neither overflows nor underflows.
    q = torch.where(largest > 0, quats / largest.clamp_min(torch.finfo(quats.dtype).tiny), identity)
    w, x, y, z = (q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        (
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ),
        dim=-1,
    ).view(-1, 3, 3)  # fmt: skip


def depths(means: Float[Tensor, "N 3"], pose: Float[Tensor, "4 4"]) -> Float[Tensor, " N"]:
    """Z of the centres along the axis of a camera, by its world-to-camera matrix; world units."""
    return means @ pose[2, :3] + pose[2, 3]


def constant_band(rgb: Float[Tensor, "N 3"]) -> Float[Tensor, "N 1 3"]:
    """RGB as spherical harmonics."""
    return ((rgb - 0.5) / SH_C0)[:, None]


def spherical_harmonics(directions: Float[Tensor, "M 3"], bands: int) -> Float[Tensor, "M B1"]:
    """Real spherical harmonics Y: the constant band and `bands` more (0, 3, 8 or 15), with the signs of 3DGS.

    Raises:
        ValueError: `bands` is none of these.
    """
    if bands not in (0, 3, 8, 15):
        raise ValueError(f"shN must hold 0, 3, 8 or 15 bands, got {bands}.")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if bands >= 3:
        c1 = 0.4886025119029199
        basis += [-c1 * y, c1 * z, -c1 * x]
    if bands >= 8:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if bands >= 15:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def basis_from(camera: Camera, means: Float[Tensor, "M 3"], bands: int) -> Float[Tensor, "M B1"]:
    """Y of the directions in which a camera sees the Gaussians; `bands` as of `spherical_harmonics`."""
    return spherical_harmonics(torch.nn.functional.normalize(means - camera.center.to(means), dim=-1), bands)


def tangent_limits(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """The ranges (low, high) of x/z and of y/z to which the projection's Jacobian is clamped.

    They extend 0.3 half fields of view beyond the image: farther outside the affine approximation diverges.
    """
    margin_x, margin_y = 0.3 * camera.width / (2 * camera.fx), 0.3 * camera.height / (2 * camera.fy)
    return (
        (-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x),
        (-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y),
    )
