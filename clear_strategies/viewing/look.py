"""Pictures of a field by the run's rasterizer, and depth in colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from clear_strategies.training.field import GaussianField
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera, Rasterizer

_SOLID: Final = 0.5  # a pixel has a depth where the Gaussians cover at least this share of it
_EXTREMES: Final = (0.02, 0.98)  # quantiles of depth at the ends of the range
DEPTH_COLORS: Final = "viridis_r"
"""matplotlib's name of the colours of depth: near is bright."""
_UNKNOWN: Final = "#cccccc"


@dataclass(eq=False)
class Painter:
    """Draws a field.

    Args:
        make: returns the rasterizer of the run; takes fields of `RasterSettings`, which override the run's.
    """

    field: GaussianField
    make: Callable[..., Rasterizer]
    _as_measured: Rasterizer = field(init=False)
    _over_black: Rasterizer = field(init=False)

    def __post_init__(self) -> None:
        self._as_measured, self._over_black = self.make(), self.make(background=(0.0, 0.0, 0.0))

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
        painted = replace(splats, sh0=((rgb - 0.5) / SH_C0)[:, None], shN=splats.shN[:, :0], rgb_offset=None)
        return self._over_black(painted, camera).image


def depth_range(depth: Float[Tensor, "*shape"]) -> tuple[float, float]:
    """The range that the colours span, of depths in world units; those that are not finite are left out. 0 to 1 where none is."""
    known = depth[depth.isfinite()].cpu().numpy()  # torch's own quantile takes 16 million numbers at most
    if not len(known):
        return 0.0, 1.0
    near, far = (float(np.quantile(known, q)) for q in _EXTREMES)
    return near, max(far, near * (1 + 1e-6) + 1e-6)


def colored(depth: Float[Tensor, "H W"], near: float, far: float) -> UInt8[np.ndarray, "H W 3"]:
    """Depth in colours, grey where there is none."""
    from matplotlib import colormaps

    colors = colormaps[DEPTH_COLORS].with_extremes(bad=_UNKNOWN)
    return np.asarray(colors(((depth - near) / (far - near)).numpy(), bytes=True)[..., :3])
