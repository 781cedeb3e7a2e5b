"""Floor 4: what a scene does not need, decided from the scene itself while it trains.

Exact skips (rows that do not move, tiles that nobody asked for, HR while λ_HR = 0) are always on, because nothing changes
by them. Those here change the result a little, so each is a setting, its default is chosen by measurement
(docs/explanation/evidence.md), the plan names those that are on, and the work log counts what was left out.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from jaxtyping import Bool
from torch import Tensor

from clear_strategies.core import deferred, images
from clear_strategies.core.deferred import Number
from clear_strategies.core.view import Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.schedules import milestone

_log = logging.getLogger(__name__)

_REDUCED: Final = 2  # the coarse reference has half the size of the fine one


@dataclass(frozen=True, slots=True)
class Skips:
    """Which work is left out. The defaults leave out nothing.

    Args:
        coarse_until: until this iteration HR is drawn and compared at half its size: structure comes before detail.
        hr_every: from `hr_every_from` on, HR takes part in every n-th iteration only.
        flat: HR tiles are not drawn where the reference adds less than this to U(I_LR), mean over the tile, image units;
            LR looks after them. 0: all tiles are drawn.
        plateau_gain: once the training views' loss, mean over `plateau_window` iterations, is not at least this share below
            that of the window before, the rest of the plateau is left out: training goes on at `plateau_to`, where the
            learning rates have nearly fallen and test views still gain; 0: never. Not before `plateau_from`, when the
            structure has settled.

    Raises:
        ValueError: a setting is outside its range.
    """

    coarse_until: int = milestone(0)
    hr_every: int = 1
    hr_every_from: int = milestone(5_000)
    flat: float = 0.0
    plateau_gain: float = 0.0
    plateau_window: int = milestone(500)
    plateau_from: int = milestone(5_000)
    plateau_to: int = milestone(8_000)

    def __post_init__(self) -> None:
        if self.hr_every < 1:
            raise ValueError(f"hr_every must be at least 1 iteration, got {self.hr_every}.")
        if not 0 <= self.flat < 1:
            raise ValueError(f"flat must lie in [0, 1) image units, got {self.flat}.")
        if not 0 <= self.plateau_gain < 1:
            raise ValueError(f"plateau_gain must lie in [0, 1), got {self.plateau_gain}.")
        if self.coarse_until < 0:
            raise ValueError(f"coarse_until must be at least 0 iterations, got {self.coarse_until}.")

    def says(self) -> list[str]:
        """One phrase for each that is on, for the plan."""
        phrases = []
        if self.coarse_until > 0:
            phrases.append(f"HR at half its size until iteration {self.coarse_until}")
        if self.hr_every > 1:
            phrases.append(f"HR but every {self.hr_every} iterations from {self.hr_every_from}")
        if self.flat > 0:
            phrases.append(f"HR tiles to which the reference adds less than {self.flat:.4f}")
        if self.plateau_gain > 0:
            phrases.append(
                f"what is left until {self.plateau_to} once {self.plateau_window} iterations gain less than "
                f"{self.plateau_gain:.1%}"
            )
        return phrases


class SkipPolicy:
    """The skips of one run. Nothing here changes with time but caches, so that resuming needs nothing of it."""

    def __init__(self, skips: Skips | None = None) -> None:
        self.skips = skips if skips is not None else Skips()
        self._coarse: dict[str, View] = {}
        self._wanted: dict[tuple[str, int], tuple[Bool[Tensor, "_ _"], int]] = {}  # and how many are not

    def view(self, view: View, t: int) -> View:
        """The view as it is looked at in iteration t: with a coarse reference first, where LR divides evenly."""
        if t > self.skips.coarse_until or view.factor % _REDUCED:
            return view
        if view.name not in self._coarse:
            hr = Photo(view.hr.camera.scaled(1 / _REDUCED), images.downsample(view.hr.image, _REDUCED, "area"))
            self._coarse[view.name] = replace(view, hr=hr, truth=None)
        return self._coarse[view.name]

    def hr_due(self, t: int, work_log: WorkLog) -> bool:
        """Whether iteration t looks at HR at all."""
        s = self.skips
        if t <= s.hr_every_from or t % s.hr_every == 0:
            return True
        work_log.skip("HR scale", f"every {s.hr_every} iterations (skips.hr_every)")
        return False

    def wanted(self, view: View, tile: int, work_log: WorkLog) -> Bool[Tensor, "th tw"] | None:
        """The HR tiles, `tile` px wide, worth drawing; None: all of them."""
        if self.skips.flat == 0:
            return None
        key = (view.name, view.factor)
        if key not in self._wanted:
            self._wanted[key] = self._with_detail(view, tile)
        wanted, flat = self._wanted[key]
        if not flat:
            return None
        work_log.skip("HR tiles", "flat reference (skips.flat)", flat)
        return wanted

    def settled(self, history: Sequence[dict[str, Number]], t: int) -> bool:
        """Whether the training views have stopped improving by iteration t, which then is followed by `plateau_to`."""
        s, window = self.skips, self.skips.plateau_window
        if s.plateau_gain == 0 or window < 1 or t % window or not s.plateau_from + 2 * window <= t < s.plateau_to:
            return False
        rows = deferred.resolve(history[t - 2 * window : t])
        column = "loss_base" if any("loss_base" in row for row in rows[window:]) else "loss_lr"
        before, now = ([row[column] for row in part if column in row] for part in (rows[:window], rows[window:]))
        if not before or not now:
            return False
        return math.fsum(now) / len(now) > (1 - s.plateau_gain) * math.fsum(before) / len(before)

    def _with_detail(self, view: View, tile: int) -> tuple[Bool[Tensor, "th tw"], int]:
        added = (view.hr.image - images.upsample(view.lr.image, view.factor)).abs()
        wanted = images.patch_means(added, tile) >= self.skips.flat
        flat = int((~wanted).sum())
        _log.info(
            "%s: %d of %d HR tiles (%d px) are flat: LR alone looks after them.",
            view.name, flat, wanted.numel(), tile,
        )  # fmt: skip
        return wanted, flat
