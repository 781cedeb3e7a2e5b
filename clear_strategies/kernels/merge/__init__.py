"""The merge in one pass over the Gaussians, for trainers that have their own optimizer: gradients in, the merged gradient out.

    out = before + scale (g_LR + λ_HR ĝ_HR + stiffness (θ - θ^a))                                    Eq. 7, 8, 16

`merging.conductor.Conductor.merge` and `strategies.gco.GCO.correct_in_torch` specify it. `cpp` runs on the CPU, `warp` on
CUDA; both share the source of the decisions with the per-Gaussian step of this package's trainer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.compiled_rules import CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.core.deferred import Number
from rasterizers.interface import BackendUnavailable
from rasterizers.native import load_kernels
from rasterizers.warp_runtime import require_warp

WIDEST = 45
"""Numbers of a Gaussian in one attribute, at most: three degrees of spherical harmonics."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """One attribute's gradients, contiguous float32 [N, …]; None is 0.

    Args:
        out: receives the result; it may be `lr`.
        lr: scale · g_LR + before. before: what the gradient was before this backward pass.
        hr: g^HR. None for sh0 and shN: from the colour, if there is one.
        p, anchor: θ and θ^a, for the pull of the anchor.
    """

    out: Tensor
    lr: Tensor | None = None
    before: Tensor | None = None
    hr: Tensor | None = None
    p: Tensor | None = None
    anchor: Tensor | None = None
    stiffness: float = 0.0


class Colour(NamedTuple):
    """g^HR of the spherical harmonics as its factors, Y ⊗ ∇rgb."""

    rgb: Float[Tensor, "N 3"]
    basis: Float[Tensor, "N B1"]


class Merged(NamedTuple):
    """What was counted, and whether every number of the result is finite; on a device it is not known yet."""

    counts: ConflictCounts
    finite: Number


@runtime_checkable
class Merge(Protocol):
    """Merges the attributes, and writes `out` of each."""

    def __call__(
        self, attributes: Mapping[str, Rows], rule: CorrectionRule | None, q: Float[Tensor, " N"] | None, *,
        colour: Colour | None = None, keeps_lr: bool = True, lambda_hr: float = 1.0, scale: float = 1.0,
    ) -> Merged:  # fmt: skip
        """
        Args:
            attributes: by gsplat's names, and "detail", which is compared with nothing.
            rule: None: nothing is corrected. q: reliability; None: 0.
            keeps_lr: False: out is ĝ_HR alone.
            lambda_hr: 0: neither compared nor added.
        """
        ...


def compiled(tensors: Iterable[Tensor]) -> Merge | None:
    """The compiled pass for gradients like these; None where there is none: another type or device, wider rows, or no kernels."""
    gradients = list(tensors)
    first = gradients[0]
    if any(g.dtype != torch.float32 or g.device != first.device or g.shape[1:].numel() > WIDEST for g in gradients):
        return None
    return _for_device(first.device.type)


@cache
def _for_device(device: str) -> Merge | None:
    try:
        if device == "cpu":
            load_kernels("clear_strategies.kernels")
            from clear_strategies.kernels.merge import cpp

            return cpp.merge
        if device == "cuda":
            require_warp("the compiled merge", device, "torch merges in its place")
            from clear_strategies.kernels.merge import warp

            return warp.merge
    except BackendUnavailable:
        pass
    return None
