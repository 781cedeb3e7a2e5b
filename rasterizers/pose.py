"""The gradient of a camera's pose from those of the Gaussians: a camera that moves sees them move the other way."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.geometry import basis_from
from rasterizers.interface import Camera, SplatGradients, Splats


@torch.no_grad()
def pose_gradient(splats: Splats, camera: Camera, g: SplatGradients) -> Float[Tensor, "4 4"]:
    """∂L/∂(world to camera), of the first cotangent.

    It is exact along every rigid motion; along others, which would shear the scene, it is 0. With p = R μ + t, a small motion of
    the camera, R → exp(ω) R and t → exp(ω) t + δ, moves the Gaussians by Rᵀ(ω × p + δ) and turns them by Rᵀω. Their directions of
    view change by δ alone, since ω turns the camera about its own centre.
    """
    pose = camera.world_to_camera.to(splats.means.device, torch.float64)
    R, t = pose[:3, :3], pose[:3, 3]
    moved = g.means[0].double()
    p, d_p = splats.means.detach().double() @ R.T + t, (moved - _by_direction(splats, camera, g).double()) @ R.T
    q, d_q = splats.quats.detach().double(), g.quats[0].double()
    w, v, d_w, d_v = q[:, :1], q[:, 1:], d_q[:, :1], d_q[:, 1:]
    turned = 0.5 * (w * d_v - d_w * v + torch.linalg.cross(v, d_v)).sum(0)  # of the quaternion (0, ω) ⊗ q / 2
    d_ω = torch.linalg.cross(p, d_p).sum(0) + R @ turned
    d_t = R @ moved.sum(0)
    x, y, z = (d_ω - torch.linalg.cross(t, d_t)).tolist()
    skew = R.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    gradient = R.new_zeros(4, 4)
    gradient[:3, :3], gradient[:3, 3] = skew @ R / 2, d_t
    return gradient


def _by_direction(splats: Splats, camera: Camera, g: SplatGradients) -> Float[Tensor, "N 3"]:
    """The part of ∂L/∂μ that comes of the direction of view, by the higher bands of the colour."""
    if not splats.shN.shape[1]:
        return torch.zeros_like(splats.means)
    with torch.enable_grad():
        means = splats.means.detach().requires_grad_()
        basis = basis_from(camera, means, splats.shN.shape[1])
        rgb = (basis[:, 1:, None] * splats.shN.detach()).sum(1)
        (found,) = torch.autograd.grad(rgb, means, g.rgb[0])
    return found
