"""Bicubic enlargement as a prior: it adds no detail beyond LR."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images


@dataclass(frozen=True, slots=True)
class Bicubic:
    """U(I_LR)."""

    label: str = field(default="bicubic (no detail beyond LR)", init=False)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        return images.quantize(images.upsample(lr, factor))
