"""SR images that depend less on what a network invents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import refuse
from clear_strategies.data.priors.cache import Cached, cached
from clear_strategies.data.priors.interface import Prior

_ORIENTATIONS: Final = tuple((turns, mirrored) for turns in range(4) for mirrored in (False, True))
"""Quarter turns, and whether the photo is mirrored first."""


@dataclass(frozen=True, slots=True)
class SelfEnsembled:
    """The mean of what a network makes of a photo in all eight orientations (geometric self-ensemble; Lim et al., EDSR, 2017).

    Detail that a network invents changes where the photo is turned or mirrored; what the photo shows stays. The network runs
    eight times.

    Args:
        prior: a network; each orientation of each photo is cached.

    Raises:
        SettingError: `prior` is no network. Other priors know their views by name, or do not depend on the orientation.
    """

    prior: Prior

    def __post_init__(self) -> None:
        network = cached(self.prior)
        if not isinstance(network, Cached):
            refuse("prior.prior", "must be a network", type(network).__name__, "use that prior without SelfEnsembled")
        object.__setattr__(self, "prior", network)

    @property
    def passes(self) -> int:
        return len(_ORIENTATIONS)

    @property
    def label(self) -> str:
        return f"{self.prior.label}, mean of {self.passes} orientations"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        total = lr.new_zeros(lr.shape[0] * factor, lr.shape[1] * factor, 3)
        for turns, mirrored in _ORIENTATIONS:
            turned = torch.rot90(lr.flip(1) if mirrored else lr, turns).contiguous()
            sr = torch.rot90(self.prior(name, turned, factor), -turns)
            total += sr.flip(1) if mirrored else sr
        return images.quantize(total / self.passes)
