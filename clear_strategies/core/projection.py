"""From the pixels of one camera to those of another, by inverse depth. Pixel (0, 0) spans [0, 1)²."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import Camera


def towards(camera: Camera, other: Camera) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, " 3"]]:
    """(K' R K⁻¹ x of each pixel x, K' t), float64: where (R, t) leads from `camera` to `other`, whose intrinsics are K'.

    A pixel at inverse depth d lies at (u, v) = (X, Y) / Z of the other image with (X, Y, Z) = K' R K⁻¹ x + d K' t, and Z / d
    is its depth there.
    """
    mine, theirs = (c.world_to_camera.double().cpu() for c in (camera, other))
    R = theirs[:3, :3] @ mine[:3, :3].T
    t = theirs[:3, 3] - R @ mine[:3, 3]
    K, K_other = (intrinsics(c) for c in (camera, other))
    H, shift = K_other @ R @ torch.linalg.inv(K), K_other @ t
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5)[None, :, None]
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5)[:, None, None]
    return x * H[:, 0] + y * H[:, 1] + H[:, 2], shift


def intrinsics(camera: Camera) -> Float[Tensor, "3 3"]:
    """K, float64 on the CPU."""
    return torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=torch.float64)
