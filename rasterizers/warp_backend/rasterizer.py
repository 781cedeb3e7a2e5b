"""The class of the Warp backend. Warp is imported by the first construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rasterizers.interface import Camera, Rendering, Splats
from rasterizers.warp_backend.settings import WarpSettings


@dataclass(frozen=True, slots=True)
class WarpRasterizer(WarpSettings):
    """Warp kernels for CUDA; the same kernels run on a CPU, slowly, to check them."""

    def draw(self, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> list[Rendering]:
        """Jobs of one pose share colour and depth order."""
        from rasterizers.warp_backend.frame import Frame

        return [*Frame(self, jobs, depth).draw()]
