"""Back-projection of SR images, which makes them agree with their LR photos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, get_args

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import require_choice, require_whole
from clear_strategies.core.images import DownKernel
from clear_strategies.data.priors.interface import Prior, SuperResolved, cached, super_resolved

_MOST_ROUNDS: Final = 100  # each about halves the difference, which is below float32's resolution after 30


@dataclass(frozen=True, slots=True)
class BackProjected:
    """Changes another prior's SR images until, reduced, they equal their LR photos (`images.back_projected`).

    An SR network invents detail, which may also change what its LR photo shows. Iterative back-projection (Irani and Peleg,
    1991) removes that part and keeps the rest.

    Args:
        prior: any other prior; a network is cached.
        rounds: how often the difference to the LR photo is projected back, in [1, 100].
        down: D, the operator by which LR photos are made.

    Raises:
        SettingError: a setting is outside its range.
    """

    prior: Prior
    rounds: int = 10
    down: DownKernel = "bicubic"

    def __post_init__(self) -> None:
        require_whole("decorators.back_projected.rounds", self.rounds, least=1, most=_MOST_ROUNDS)
        require_choice("decorators.back_projected.down", self.down, get_args(DownKernel))
        object.__setattr__(self, "prior", cached(self.prior))

    @property
    def label(self) -> str:
        return f"{getattr(self.prior, 'label', 'unknown')}, back-projected"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        return self.super_resolved(name, lr, factor).image

    def super_resolved(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> SuperResolved:
        """The SR image, and the difference of the prior's own image, reduced, from the LR photo."""
        sr = super_resolved(self.prior, name, lr, factor).image.to(lr)  # a function may have made it on a GPU
        disagreement = (images.downsample(sr, factor, self.down) - lr).abs()
        moved = images.back_projected(sr, lr, factor, self.rounds, self.down)
        return SuperResolved(images.quantize(moved), disagreement)
