"""Functions of `reference` in C++, for contiguous float32 tensors on a CPU."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.kernels import native
from rasterizers.native import threads


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


def wander(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    gate: Float[Tensor, " N"],
    rows: Int[Tensor, " K"],
    eta: Float[Tensor, "K 3"],
    strength: float,
) -> None:
    native.module().wander(means, quats, log_scales, gate, rows, eta, strength, threads())
