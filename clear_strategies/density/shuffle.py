"""Adaptive density control, followed once by S2Gaussian's Gaussian Shuffle Split (Wan et al. 2025)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.core.checks import require_number
from clear_strategies.core.view import View
from clear_strategies.density.adaptive import Density, DensitySettings
from clear_strategies.density.threshold import count_passing, topk_mask
from clear_strategies.schedules import milestone
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam
from rasterizers.geometry import rotation_matrix

_log = logging.getLogger(__name__)

_CHILDREN: Final = 6  # one at each side of the centre, along each axis
_ASIDE: Final = 0.5  # of the axis's scale
_ALONG: Final = 4.0  # divisor of the scale of that axis
_ACROSS: Final = 1.9  # divisor of the two other scales


@dataclass(frozen=True, slots=True)
class ShuffleSettings(DensitySettings):
    """Density control that ends with the Shuffle Split.

    Args:
        split_at: the iteration after which Gaussians are split into six smaller ones each. No density control follows.
        split_above: opacity from which they are split, in [0, 1); if `max_gaussians` limits their number, the most opaque ones.
    """

    split_at: int = milestone(5_000)
    split_above: float = 0.5

    def __post_init__(self) -> None:
        DensitySettings.__post_init__(self)
        require_number("split_above", self.split_above, below=1)

    def densifier(self, field: GaussianField, views: Sequence[View], seed: int) -> Density:
        return ShuffleSplit(self, field, views, seed)


class ShuffleSplit(Density):
    """`Density` until `split_at`, then one split, which makes room for the detail of HR."""

    settings: ShuffleSettings
    is_split = False

    @property
    def second_stage(self) -> int:
        return self.settings.split_at + 1

    def settled(self, t: int) -> bool:
        return self.is_split

    def step(self, field: GaussianField, optimizer: Adam, t: int, resized: Callable[[Int[Tensor, " M"]], None]) -> bool:
        if self.is_split:
            return False
        changed = super().step(field, optimizer, t, resized)
        if t >= self.settings.split_at:
            resized(self.split(field, optimizer, t))
            self.is_split = changed = True
        return changed

    def split(self, field: GaussianField, optimizer: Adam, t: int) -> Int[Tensor, " M"]:
        """Split every opaque Gaussian; returns parents [M]. Seen along an axis two children overlap, so each has the opacity
        1 - √(1 - o).
        """
        s, n = self.settings, len(field)
        opacities = field.filtered_opacities()
        room = max(0, s.max_gaussians - n) // (_CHILDREN - 1)
        chosen = topk_mask(opacities, min(count_passing(opacities, s.split_above), room))
        rows = torch.arange(n, device=chosen.device)
        stay, parent = rows[~chosen], rows[chosen]
        parents = self._succeed(field, optimizer, stay, parent.repeat(_CHILDREN))
        children = slice(len(stay), len(parents))
        side = torch.arange(_CHILDREN, device=parents.device).repeat_interleave(len(parent))
        axis = torch.nn.functional.one_hot(side // 2, 3).to(field.scales.data)
        offset = axis * (2 * (side % 2) - 1)[:, None] * _ASIDE * field.scales.data[children].exp()
        field.means.data[children] += (rotation_matrix(field.quats.data[children]) @ offset[..., None])[..., 0]
        field.scales.data[children] -= axis * math.log(_ALONG) + (1 - axis) * math.log(_ACROSS)
        o = field.opacities.data[children]
        field.opacities.data[children] = torch.logit(-torch.expm1(torch.nn.functional.logsigmoid(-o) / 2), eps=1e-6)
        _log.debug("t=%d: %d shuffled into six each: %d -> %d Gaussians.", t, len(parent), n, len(parents))
        return parents

    def state_dict(self) -> dict[str, Tensor]:
        return {**super().state_dict(), "is_split": torch.tensor(self.is_split)}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        super().load_state_dict(tensors)
        self.is_split = bool(tensors["is_split"])
