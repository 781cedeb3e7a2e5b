"""Pictures of a field by the run's rasterizer, and depth in colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from clear_strategies.training.field import GaussianField
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera, Rasterizer

_SOLID: Final = 0.5  # a pixel has a depth where the Gaussians cover at least this share of it
_SAMPLED: Final = 5  # cameras that the range of depths is taken from, about
_EXTREMES: Final = (0.02, 0.98)  # quantiles of depth at the ends of the range
DEPTH_COLORS: Final = "viridis_r"
"""matplotlib's name of the colours of depth: near is bright."""
_UNKNOWN: Final = 0.8  # grey


@dataclass(eq=False)
class Painter:
    """Draws a field.

    Args:
        make: returns the rasterizer of the run; takes fields of `RasterSettings`, which override the run's.
    """

    field: GaussianField
    make: Callable[..., Rasterizer]

    @torch.no_grad()
    def color(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The picture, in [0, 1], on the CPU."""
        image = self._as_measured(self.field.baked(), camera).image
        return image.clamp(0, 1).nan_to_num().cpu()

    @torch.no_grad()
    def depth(self, camera: Camera) -> Float[Tensor, "H W"]:
        """Mean depth z of what a pixel shows, world units; nan where less than half of it is covered."""
        pose = camera.world_to_camera.to(self.field.means)
        z = (self.field.means.data @ pose[2, :3]) + pose[2, 3]
        drawn = self._numbers(camera, torch.stack([z, torch.ones_like(z), torch.zeros_like(z)], dim=1))
        z_sum, alpha = drawn[..., 0], drawn[..., 1]
        return torch.where(alpha >= _SOLID, z_sum / alpha.clamp_min(_SOLID), torch.nan).cpu()

    @torch.no_grad()
    def numbers(self, camera: Camera, values: Float[Tensor, " N"]) -> Float[Tensor, "H W"]:
        """A number >= 0 per Gaussian, blended as colours are; 0 where nothing is."""
        return self._numbers(camera, values[:, None].expand(-1, 3).to(self.field.means))[..., 0].cpu()

    def _numbers(self, camera: Camera, rgb: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 3"]:
        """Render the Gaussians with these colours over black."""
        splats = self.field.baked()
        colored = replace(splats, sh0=((rgb - 0.5) / SH_C0)[:, None], shN=splats.shN[:, :0], rgb_offset=None)
        return self._over_black(colored, camera).image

    @cached_property
    def _as_measured(self) -> Rasterizer:
        return self.make()

    @cached_property
    def _over_black(self) -> Rasterizer:
        return self.make(background=(0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class DepthScale:
    """The range of depths that the colours span, world units."""

    near: float
    far: float

    @classmethod
    def of(cls, painter: Painter, cameras: Sequence[Camera]) -> DepthScale:
        """From the depths that a few of the cameras see."""
        sampled = cameras[:: math.ceil(len(cameras) / _SAMPLED)]
        return cls.spanning(torch.cat([painter.depth(camera).flatten() for camera in sampled]))

    @classmethod
    def spanning(cls, depth: Float[Tensor, "*shape"]) -> DepthScale:
        """From depths; those that are not finite are left out. 0 to 1 where none is finite."""
        known = depth[depth.isfinite()].cpu().numpy()  # torch's own quantile takes 16 million numbers at most
        if not len(known):
            return cls(0.0, 1.0)
        near, far = (float(np.quantile(known, q)) for q in _EXTREMES)
        return cls(near, max(far, near * (1 + 1e-6) + 1e-6))

    def picture(self, depth: Float[Tensor, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
        """Depth in colours, grey where there is none."""
        from matplotlib import colormaps

        values = ((depth - self.near) / (self.far - self.near)).clamp(0, 1).numpy()
        colored = colormaps[DEPTH_COLORS](np.nan_to_num(values))[..., :3]
        colored[~np.isfinite(values)] = _UNKNOWN
        return np.asarray((colored * 255).round().astype(np.uint8))
