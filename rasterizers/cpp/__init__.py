"""The backend "cpp": compiled kernels for the CPU, in float32, and in float64 for checks.

The stages have the names of `rasterizers.reference`: project, bin, blend, and their VJPs. The headers in `src/` do not
depend on Python; `src/bindings.cpp` wraps them. `rasterizers.native` loads the module for this processor.

Results have the same bits for any number of threads and any memory budget.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import chain
from typing import ClassVar, Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.dlpack import from_dlpack

from rasterizers.backend import (
    Backend,
    of_accumulated,
    packed_rows,
    require_cotangents,
    require_finite_splats,
    require_splats,
)
from rasterizers.interface import Camera, RasterSettings, Rendering, SplatGradients, Splats, Traits
from rasterizers.native import load_kernels, threads

_LONGEST_SIDE: Final = 32 << 15  # px: bins of 32 px are numbered in 16 bits


@dataclass(frozen=True, slots=True)
class CppRasterizer(Backend):
    """Compiled kernels for the CPU.

    Args:
        memory: MiB that the lists of one image, and of its gradients, may take; beyond it the image is drawn in parts, with
            the same bits. `MemoryError` before anything is drawn, where a single part of 32 px is beyond it.
        threads: None: `rasterizers.native.threads()`.
        isa: instruction set of the kernels in float32, "avx512", "avx2" or "baseline"; None: the fastest here.

    Raises:
        BackendUnavailable: the kernels were not compiled, or this processor cannot run those of `isa`.
        ValueError: a setting is out of range.
    """

    traits: ClassVar[Traits] = Traits(
        devices=frozenset({"cpu"}),
        dtypes=frozenset({torch.float32, torch.float64}),
        native_threads=True,
        depth=True,
        absgrad=True,
        depth_gradient=True,
        radii=True,
        shears=True,
    )

    memory: int = 4096
    threads: int | None = None
    isa: str | None = None

    def __post_init__(self) -> None:
        Backend.__post_init__(self)
        if self.memory < 1:
            raise ValueError(f"memory must be at least 1 MiB, got {self.memory}.")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}.")
        load_kernels(__name__, self.isa)

    @property
    def module(self) -> str:
        """The instruction set of the kernels in float32."""
        return str(load_kernels(__name__, self.isa).isa)

    def draw(self, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> list[Rendering]:
        """Jobs of one pose share projection, colour and depth order."""
        frame = _Frame(self, jobs)
        return [CppRendering(frame, i, depth=z) for i, z in enumerate(depth)]


class _Frame:
    """One projection for several pixel grids: the native frame, and the tensors that its VJP reads again."""

    def __init__(self, settings: CppRasterizer, jobs: Sequence[tuple[Splats, Camera]]) -> None:
        splats, camera = jobs[0]
        for job, view in jobs:
            require_splats(job, settings.traits)
            if max(view.width, view.height) > _LONGEST_SIDE:
                raise ValueError(
                    f"the cpp rasterizer draws images of up to {_LONGEST_SIDE} px a side, got {view.width}x{view.height}."
                )
        n = len(splats)
        self.threads = settings.threads if settings.threads is not None else threads()
        self.cameras = [camera for _, camera in jobs]
        shared = (splats.means, splats.quats, splats.scales, splats.sh0)
        self.shared = (*(x.detach().contiguous() for x in shared), packed_rows(splats.shN.detach()))
        # Referenced here because the native frame does not keep them alive.
        self.opacities = [job.opacities.detach().contiguous() for job, _ in jobs]
        self.offsets = [None if job.rgb_offset is None else job.rgb_offset.detach().contiguous() for job, _ in jobs]
        double = splats.means.dtype == torch.float64  # for checks: one module serves all processors
        kernels = importlib.import_module(f"{__name__}._float64") if double else load_kernels(__name__, settings.isa)
        self.native = kernels.Frame(
            **{field.name: getattr(settings, field.name) for field in fields(RasterSettings)},
            world_to_camera=[*chain.from_iterable(camera.world_to_camera.tolist())],
            budget=settings.memory << 20,
        )
        self.means2d = [self.empty(n, 2) for _ in jobs]
        self.visible = [torch.empty(n, dtype=torch.bool, device="cpu") for _ in jobs]
        grids = [[c.fx, c.fy, c.cx, c.cy, float(c.width), float(c.height)] for c in self.cameras]
        if not self.native.project(
            *self.shared, grids, self.opacities, self.offsets, self.means2d, self.visible, self.threads
        ):
            for job, _ in jobs:
                require_finite_splats(job)

    def empty(self, *shape: int) -> Tensor:
        """An uninitialised tensor in recycled memory, because fresh pages cost more than filling them."""
        return from_dlpack(self.native.empty(shape))

    @cached_property
    def basis(self) -> Float[Tensor, "N B1"]:
        """Y of this pose's directions, computed once for all grids."""
        Y = self.empty(len(self.shared[0]), self.shared[4].shape[1] + 1)
        self.native.basis(Y, self.threads)
        return Y


class CppRendering:
    """An image on one pixel grid of a frame."""

    def __init__(self, frame: _Frame, grid: int, *, depth: bool) -> None:
        self._frame, self._grid = frame, grid
        camera = frame.cameras[grid]
        self.image: Float[Tensor, "H W 3"] = frame.empty(camera.height, camera.width, 3)
        self.alpha: Float[Tensor, "H W"] = frame.empty(camera.height, camera.width)
        self.depth: Float[Tensor, "H W"] | None = frame.empty(camera.height, camera.width) if depth else None
        self.means2d: Float[Tensor, "N 2"] = frame.means2d[grid]
        self.visible: Bool[Tensor, " N"] = frame.visible[grid]
        frame.native.draw(grid, self.image, self.alpha, self.depth, frame.threads)

    @property
    def radii(self) -> Int[Tensor, "N 2"]:
        """See `WithTraits`."""
        out = torch.empty(len(self.visible), 2, dtype=torch.int32, device="cpu")
        self._frame.native.radii(self._grid, out, self._frame.threads)
        return out

    @property
    def shears(self) -> Float[Tensor, "N 3"]:
        """See `WithTraits`."""
        out = self._frame.empty(len(self.visible), 3)
        self._frame.native.shears(self._grid, out, self._frame.threads)
        return out

    def vjp(
        self,
        cotangents: Float[Tensor, "K H W 3"],
        *,
        absgrad: bool = False,
        alpha: Float[Tensor, "K H W"] | None = None,
        depth: Float[Tensor, "K H W"] | None = None,
    ) -> SplatGradients:
        """One pass for up to three cotangents, with depth or absolute gradients for one; see `WithTraits`."""
        require_cotangents(cotangents, self.image)
        v_alpha, v_depth = (None if x is None else x.contiguous() for x in of_accumulated(self, alpha, depth))
        absolute = self._frame.empty(len(cotangents), len(self.visible), 2) if absgrad else None
        return self._gradients(cotangents, v_alpha, v_depth, absolute)

    def summed_vjp(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"]) -> SplatGradients:
        """One pass for two or three cotangents; see `WithTraits`."""
        require_cotangents(cotangents, self.image)
        if len(cotangents) not in (2, 3) or self.image.dtype == torch.float64:
            return self.vjp(cotangents).summed(weight)
        return self._gradients(cotangents, weight=weight.detach().to(self.image).contiguous())

    def _gradients(
        self, cotangents: Tensor, v_alpha: Tensor | None = None, v_depth: Tensor | None = None, absolute: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> SplatGradients:  # fmt: skip
        k, n, frame = len(cotangents), len(self.visible), self._frame
        sums = k if weight is None else k - 1
        means, quats, scales = (frame.empty(sums, n, width) for width in (3, 4, 3))
        opacities, screen, rgb = frame.empty(sums, n), frame.empty(k, n, 2), frame.empty(k, n, 3)
        frame.native.vjp(
            self._grid, cotangents.detach().to(self.image).contiguous(), v_alpha, v_depth, means, quats, scales, opacities,
            screen, rgb, absolute, weight, frame.threads,
        )  # fmt: skip
        return SplatGradients(means, quats, scales, opacities, screen, rgb, frame.basis, absolute)
