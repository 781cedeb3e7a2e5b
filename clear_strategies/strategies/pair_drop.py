"""PairDrop: what two halves of a field show of a view must agree in its low frequencies (PairDropGS, 2026).

Dropout alone asks each random subset of the Gaussians to match the photo. Here two subsets are compared with each other, at a
size at which only low frequencies are left: surfaces and shading, on which every subset of a good field agrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.seeds import dropout_mask, generator_at, one_of
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.schedules import milestone
from clear_strategies.strategies.base import Drawn, Strategy


@dataclass(frozen=True)
class PairDrop(Strategy):
    """Consistency of two dropped subsets. For this package's trainer: another one draws no picture for a strategy.

    Args:
        share: of the Gaussians that each subset lacks, in (0, 1).
        reduced: the size of the compared pictures, as a divisor of LR's, at least 1.
        weight: of their LR loss, > 0, as a multiple of a photo's.
        every, start: iterations from one comparison to the next, and the first that may have one.

    Raises:
        SettingError: a setting is outside its range.
    """

    share: float = 0.2
    reduced: int = 2
    weight: float = 0.5
    every: int = 2
    start: int = milestone(2_000)

    def __post_init__(self) -> None:
        require_number("share", self.share, above=0, below=1)
        require_number("weight", self.weight, above=0)
        for name in ("reduced", "every"):
            require_whole(name, getattr(self, name), least=1)

    def on_views(self, views: Sequence[View]) -> None:
        self.cache["cameras"] = [view.lr.reduced(self.reduced).camera for view in views]

    def drawn_views(self, t: int, drawn: Drawn) -> Sequence[ExtraView]:
        """What one subset shows of a training view, for another to match: functions of (seed, t)."""
        seed, cameras = self.seed, self.cache.get("cameras")
        if t < self.start or t % self.every or not cameras:
            return ()
        camera = one_of(cameras, generator_at(seed, t))
        one, other = (partial(dropout_mask, p=self.share, seed=~seed, t=2 * t + k, device=self.device) for k in (0, 1))
        image = drawn.draw(camera, other)
        return (ExtraView(Photo(camera, image), torch.full_like(image[..., 0], self.weight), gate=one),)
