"""The backend "torch": the reference implementation in pure torch, float32 and float64, written to be read.

It has three steps, each in its file: `projection` (Gaussians to ellipses on the image), `tiles` (the ellipses that may
touch each tile, front to back) and `blend` (compositing, and its VJP). Autograd differentiates the projection. The VJP of
blending is written by hand, because autograd would keep a dozen tensors per pair of pixel and Gaussian.

The other backends are tested against this one. It can also train: `lanes` bounds its memory independently of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rasterizers.backend import Backend, of_accumulated, require_cotangents, require_finite_splats, require_splats
from rasterizers.interface import Camera, Rendering, SplatGradients, Splats, Traits
from rasterizers.reference.blend import blend, blend_vjp
from rasterizers.reference.projection import project
from rasterizers.reference.tiles import TileGrid, list_tiles

_TILE: Final = 8  # px; takes half the time of 16 in torch


@dataclass(frozen=True, slots=True)
class ReferenceRasterizer(Backend):
    """Pure torch. Deterministic on the CPU only, because index_add_ on CUDA is not.

    Args:
        lanes: pairs of pixel and Gaussian that are blended at a time, 16 to 100 bytes each.
    """

    traits: ClassVar[Traits] = Traits(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({torch.float32, torch.float64}),
        depth=True,
        absgrad=True,
        depth_gradient=True,
    )

    lanes: int = 1 << 19

    def __post_init__(self) -> None:
        Backend.__post_init__(self)
        if self.lanes < 1:
            raise ValueError(f"lanes must be at least 1 pair, got {self.lanes}.")

    def draw(self, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> list[Rendering]:
        """Jobs share nothing."""
        return [ReferenceRendering(self, *job, depth=z) for job, z in zip(jobs, depth, strict=True)]


class ReferenceRendering:
    """The image, and the tile lists that its VJP reads again."""

    def __init__(self, settings: ReferenceRasterizer, splats: Splats, camera: Camera, *, depth: bool) -> None:
        require_splats(splats, settings.traits)
        require_finite_splats(splats)
        self._settings = settings
        self._grid = grid = TileGrid(camera.width, camera.height, _TILE)
        self._projection = projection = project(splats, camera, settings, depth=depth)
        lists = list_tiles(projection, grid)
        self.means2d: Float[Tensor, "N 2"] = projection.scatter(projection.footprints.means2d.detach())
        self.visible: Bool[Tensor, " N"] = projection.scatter(lists.visible)
        tiles, transmittance, self._passes = blend(projection.table(), lists, grid, settings, settings.lanes)
        pixels = grid.to_image(tiles)
        self.image: Float[Tensor, "H W 3"] = pixels[..., :3].contiguous()
        self.depth: Float[Tensor, "H W"] | None = pixels[..., 3] if depth else None
        self.alpha: Float[Tensor, "H W"] = 1 - grid.to_image(transmittance[..., None])[..., 0]

    def vjp(
        self,
        cotangents: Float[Tensor, "K H W 3"],
        *,
        absgrad: bool = False,
        alpha: Float[Tensor, "K H W"] | None = None,
        depth: Float[Tensor, "K H W"] | None = None,
    ) -> SplatGradients:
        """One pass for all K; see `WithTraits`."""
        require_cotangents(cotangents, self.image)
        v_alpha, v_depth = of_accumulated(self, alpha, depth)
        channels = cotangents if v_depth is None else torch.cat((cotangents, v_depth[..., None]), -1)
        v = torch.stack([self._grid.to_tiles(c.to(self.image)) for c in channels])
        if v_alpha is not None:
            v_alpha = torch.stack([self._grid.to_tiles(c[..., None])[..., 0] for c in v_alpha])
        gradients = blend_vjp(
            self._projection.table(), self._passes, self._grid, self._settings, v, v_alpha, absgrad=absgrad
        )
        return self._projection.vjp(*gradients)
