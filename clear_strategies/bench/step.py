"""The per-Gaussian work of an iteration: activations, chain rule, correction, merge, Adam,
constraints.

A rasterizer that repeats recorded gradients and a tiny image leave nothing else to time. Compared
are the compiled step, the readable path, and torch's Adam alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import pandas as pd
import torch
from torch import Tensor

import rasterizers
from clear_strategies.bench.iteration import FROZEN, TOTAL, Training, field_of, view_of
from clear_strategies.bench.scenes import SETTINGS, Workload, surfaces
from clear_strategies.bench.timing import Contender, interleaved, medians, one_stage
from clear_strategies.merging.objective import Objective
from rasterizers.interface import Camera, Rasterizer, Rendering, SplatGradients, Splats

COMPILED: Final = "ours, compiled"
READABLE: Final = "ours, readable"


def measure(n: int, repeats: int, device: str, note: Callable[[str], None]) -> pd.DataFrame:
    """One row per implementation; learning rates are 0, so the Gaussians stay where they are."""
    workload = surfaces(f"{n:,} Gaussians", n, 64, 48, radius=2.0).to(device)
    rasterizer = rasterizers.load(rasterizers.fastest(device), preset="fast", **SETTINGS)
    view, recorded = view_of(workload, rasterizer), RecordedRasterizer(rasterizer)
    compiled = Training(workload, view, recorded, Objective(), "auto")
    contenders: dict[str, Contender] = {}
    if compiled.state.compiled_step is not None:
        contenders[COMPILED] = compiled
    else:
        note(f"{COMPILED}: not available on {device}; the log above says why.")
    contenders[READABLE] = Training(workload, view, recorded, Objective(), "off")
    contenders["torch, fused Adam"] = one_stage(TOTAL, device, _torch_adam(workload).step)
    ms = medians(interleaved(contenders, repeats, device=device, label=workload.name))[TOTAL]
    return pd.DataFrame(
        {"gaussians": n, "implementation": ms.index, "ms": ms.to_numpy(), "over_first": ms / ms.iloc[0]}
    )


def _torch_adam(workload: Workload) -> torch.optim.Adam:
    """The fused Adam of torch, on given gradients."""
    leaves = [p.clone().requires_grad_() for p in field_of(workload.splats).raw().values()]
    for p in leaves:
        p.grad = 1e-5 * torch.randn_like(p)
    return torch.optim.Adam(leaves, lr=0.0, eps=FROZEN.eps, fused=True)


class RecordedRasterizer:
    """Draws both scales once and repeats these renderings and their gradients ever after."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.rasterizer, self.traits = rasterizer, rasterizer.traits
        self.renderings: list[Rendering] = []

    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Rendering:
        return self.rasterizer(splats, camera, depth=depth)

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], *, depth: Sequence[bool] | None = None
    ) -> list[Rendering]:
        if not self.renderings:
            self.renderings = [_Recorded(r) for r in self.rasterizer.render_scales(jobs, depth=depth)]
        return self.renderings


class _Recorded:
    def __init__(self, rendering: Rendering) -> None:
        self.image, self.alpha, self.depth = rendering.image, rendering.alpha, rendering.depth
        self.means2d, self.visible = rendering.means2d, rendering.visible
        self._rendering, self._gradients = rendering, dict[int, SplatGradients]()

    def vjp(self, cotangents: Tensor) -> SplatGradients:
        k = len(cotangents)
        if k not in self._gradients:
            self._gradients[k] = self._rendering.vjp(cotangents)
        return self._gradients[k]
