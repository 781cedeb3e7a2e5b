"""Functions of `reference` in C++, with its arguments, for contiguous float32 tensors on a CPU."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float
from torch import Tensor

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


def wander(*arguments: Any) -> None:
    native.module().wander(*arguments, threads())
