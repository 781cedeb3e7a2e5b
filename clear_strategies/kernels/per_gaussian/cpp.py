"""Functions of `reference` in C++, with its arguments, for contiguous float32 tensors on a CPU."""

from __future__ import annotations

from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.evidence import Evidence
from clear_strategies.kernels import native
from rasterizers.native import empty, threads


def activate(
    log_scales: Float[Tensor, "N 3"], logits: Float[Tensor, " N"], filters: Float[Tensor, " N"], gate: Tensor | None
) -> tuple[Tensor, ...]:
    rows, columns = empty((2, len(logits), 3)), empty((4, len(logits)))
    gate = None if gate is None else gate.to(logits)
    native.module().activate(log_scales, logits, filters, gate, rows, columns, threads())
    return *rows, *columns


def nearest_depths(means: Float[Tensor, "N 3"], cameras: Float[Tensor, "V 20"], near: float) -> Float[Tensor, " N"]:
    z_min = means.new_full((len(means),), float("inf"))
    native.module().nearest_depths(means, cameras, near, z_min, threads())
    return z_min


def lift(
    patch_maps: Float[Tensor, "C ph pw"], centers: Float[Tensor, "N 2"], visible: Bool[Tensor, " N"], patch: float
) -> Float[Tensor, "C N"]:
    lifted = patch_maps.new_empty(len(patch_maps), len(centers))
    native.module().lift(patch_maps, centers.detach(), visible, patch, lifted, threads())
    return lifted


def evidence(
    maps: Float[Tensor, "2 ph pw"], centers: Float[Tensor, "N 2"], visible: Bool[Tensor, " N"], patch: float
) -> Evidence:
    return Evidence(*lift(maps, centers, visible, patch))


def wander(*arguments: Any) -> None:
    native.module().wander(*arguments, threads())
