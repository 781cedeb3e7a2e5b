"""The 3D smoothing filter of Mip-Splatting: no Gaussian is thinner than the cameras can sample."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import require_choice, require_number, require_whole
from clear_strategies.kernels import per_gaussian
from clear_strategies.schedules import milestone
from rasterizers.interface import Camera, RasterSettings

_log = logging.getLogger(__name__)

NEAR: Final = RasterSettings().near
"""The near plane where the rasterizer has no other. A camera samples what it draws, whatever the capture's unit; Mip-Splatting
counts what is farther than 0.2.
"""

_MARGIN: Final = 0.15  # of the image: a centre counts up to this share outside of each side (Mip-Splatting)


@dataclass(frozen=True, slots=True)
class MipFilter:
    """Settings of the 3D filter: when it is computed, and from which cameras.

    Args:
        variance: variance of the filter, in squared sampling intervals (px² of the finest camera); 0: no filter.
        cameras: which training cameras set the sampling rate; the finer ones are "hr".
        every: iterations between updates; every change of structure updates the filter as well.
        last: no update in this many last iterations of a run.
    """

    variance: float = 0.2
    cameras: Literal["hr", "lr"] = "hr"
    every: int = 100
    last: int = milestone(100)

    def __post_init__(self) -> None:
        require_number("variance", self.variance)
        require_choice("cameras", self.cameras, ("hr", "lr"))
        require_whole("every", self.every, least=1)


@torch.no_grad()
def filter_std(
    means: Float[Tensor, "N 3"], cameras: Sequence[Camera], variance: float, near: float = NEAR
) -> Float[Tensor, " N"]:
    """f_i = √variance · z_min / f_max: the filter's standard deviation in world units.

    z_min is the smallest depth among the cameras that see the centre, f_max the largest focal length of all. A
    Gaussian that no camera sees takes the largest z_min of the others; if no Gaussian is seen, there is no filter.

    Args:
        near: the near plane of the rasterizer, world units.
    """
    if variance == 0 or not len(means):
        return means.new_zeros(len(means))
    z_min = per_gaussian.nearest_depths(means.contiguous(), _as_rows(cameras).to(means), near)
    seen = z_min.isfinite()
    if not bool(seen.any()):
        _log.warning(
            "no training camera sees a Gaussian farther away than rasterizer.near=%g world units: the 3D filter is off. "
            "Lower rasterizer.near where the scene is that small.", near
        )  # fmt: skip
        return means.new_zeros(len(means))
    z_min = torch.where(seen, z_min, z_min[seen].max())
    std: Tensor = z_min * (math.sqrt(variance) / max(camera.fx for camera in cameras))
    return std


def _as_rows(cameras: Sequence[Camera]) -> Float[Tensor, "V 20"]:
    """The rows of [R | t], fx, fy, cx, cy, and the bounds of u and v, inside which a centre counts."""
    low, high = -_MARGIN, 1 + _MARGIN
    numbers = [
        (c.fx, c.fy, c.cx, c.cy, low * c.width, high * c.width, low * c.height, high * c.height) for c in cameras
    ]
    poses = torch.stack([camera.world_to_camera for camera in cameras])[:, :3].flatten(1)
    return torch.cat((poses, poses.new_tensor(numbers)), dim=1)
