"""The backend "warp": NVIDIA Warp kernels, compiled at first use from one source for CUDA and for the CPU, in float32.

The stages have the names of `rasterizers.reference`: project, bin, blend, and their VJPs. Warp is imported when a rasterizer
is constructed; `frame` launches the kernels; the other files hold the kernels, with VJPs written by hand.

Deterministic: every sum has a fixed order, and there are no floating-point atomics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rasterizers.interface import Camera, Rendering, Splats
from rasterizers.warp_backend.settings import WarpSettings


@dataclass(frozen=True, slots=True)
class WarpRasterizer(WarpSettings):
    """Warp kernels for CUDA; the same kernels run on a CPU, slowly, to check them."""

    def draw(self, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> list[Rendering]:
        """Jobs of one pose share colour and depth order."""
        from rasterizers.warp_backend.frame import WarpFrame

        return [*WarpFrame(self, jobs, depth).draw()]

    def numbers_of(self, camera: Camera, device: torch.device) -> Sequence[Tensor]:
        """See `rasterizers.interface.Recordable`."""
        from rasterizers.warp_backend.frame import numbers_of

        return numbers_of(camera, device)
