"""Work that a run leaves out where the scene does not need it.

Exact skips (rows that do not move, HR while λ_HR = 0) are always on, because they change nothing. The
skips here change the result a little. Each is a setting whose default was chosen by measurement
(docs/explanation/evidence-sparse.md); the plan lists those that are on, and the work log counts the iterations skipped.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.deferred import Number
from clear_strategies.core.view import View
from clear_strategies.errors import counted
from clear_strategies.schedules import milestone

_log = logging.getLogger(__name__)

PLATEAU_LOSS: Final = "loss_views"
"""The column of the history by which a plateau is found: the mean loss of training views, every Gaussian drawn."""

_LOOKS: Final = 6  # at each view in a window, at least: in fewer, the loss rises and falls by chance
_REDUCED: Final = 2  # the coarse SR image has half the size of the fine one
_GATED: Final = 0.5  # an opacity is drawn up to twice as high where up to half of the Gaussians are dropped


@dataclass(frozen=True, slots=True)
class Skips:
    """Settings of skipped work. The defaults skip nothing.

    Args:
        coarse_until: until this iteration, HR is rendered and compared at half its size; if that is the size of LR, LR is not
            rendered. 0: never; 10,000 steps of `clear` in gsplat's loop on the demo then gain 0.27 dB in 1.4 times the time.
        hr_every: until `coarse_until`, HR is rendered in one of this many iterations, and in all whose scores densification
            reads; 1: in all.
        plateau_gain: if the loss of the training views, rendered with all Gaussians, falls by less than this share within a
            window, training jumps to iteration `plateau_to`; 0: never.
        plateau_window: iterations between two measurements, at least six for each training view.
        plateau_from: iteration of the earliest measurement.
        plateau_to: where the jump ends. No run skips the iterations from here on, in which the learning rates fall, and HR is at
            full size.
        undrawn: once densification has ended, Gaussians too faint to be drawn in any view are removed if they are at least
            this share of all, and no strategy regularizes; 0: never.
    """

    coarse_until: int = milestone(0)
    hr_every: int = 1
    plateau_gain: float = 0.0
    plateau_window: int = milestone(500)
    plateau_from: int = milestone(5_000)
    plateau_to: int = milestone(8_000)
    undrawn: float = 0.0

    def __post_init__(self) -> None:
        for name in ("plateau_gain", "undrawn"):
            require_number(name, getattr(self, name), below=1)
        require_whole("coarse_until", self.coarse_until, least=0)
        require_whole("hr_every", self.hr_every, least=1)


@dataclass(frozen=True, slots=True)
class Plateau:
    """A plateau of the loss of the training views, at which training continues at `skips.plateau_to`.

    Args:
        n_views: training views.
    """

    skips: Skips
    n_views: int

    def __str__(self) -> str:
        window = counted(self.measurements.step, "iteration")
        return f"the loss of the training views falls by less than {self.skips.plateau_gain:.1%} in {window}"

    @property
    def measurements(self) -> range:
        """The iterations after which the training views are measured, a window apart; empty where there would be one only."""
        s = self.skips
        window = max(s.plateau_window, _LOOKS * self.n_views)
        times = range(-(-s.plateau_from // window) * window, s.plateau_to, window)
        return times if s.plateau_gain > 0 and len(times) > 1 else times[:0]

    def reached(self, history: Sequence[dict[str, Number]], t: int) -> bool:
        """True if the training views have stopped improving by iteration t, the last of the history. False if it is unknown:
        iterations were left out within the window, or at one end of it the structure has changed or another loss was measured.
        """
        times = self.measurements
        window = times.step
        if t not in times[1:] or len(history) <= window:
            return False
        rows = deferred.resolve(history)
        before, now = rows[-1 - window], rows[-1]
        if before["t"] != t - window or PLATEAU_LOSS not in before.keys() & now.keys():
            return False
        if self._measured_loss(before) != self._measured_loss(now):
            return False
        return now[PLATEAU_LOSS] > (1 - self.skips.plateau_gain) * before[PLATEAU_LOSS]

    def _measured_loss(self, row: Mapping[str, float]) -> str:
        """The name of the loss in `PLATEAU_LOSS` of a row."""
        if row["lambda_hr"] == 0:
            return "LR"
        return "HR at half its size" if row["t"] <= self.skips.coarse_until else "HR"


class SkipPolicy:
    """Applies the skips of HR and of Gaussians in one run. It stores only caches, which no checkpoint needs."""

    def __init__(self, skips: Skips | None = None) -> None:
        self.skips = skips if skips is not None else Skips()
        self._coarse: dict[str, tuple[View, View]] = {}  # a view and its coarse one, by name

    def descriptions(self, views: Sequence[View], *, hr_from: int | None = 0, in_host: bool = False) -> list[str]:
        """A phrase for each skip that is on, for the plan; one that has no effect is logged.

        Args:
            hr_from: the iteration after which there is work on HR to leave out; None: there is none.
            in_host: the iterations are a host's, so that none is left out.
        """
        s, phrases, plateau = self.skips, [], Plateau(self.skips, len(views))
        hr_is_left_out = hr_from is not None and s.coarse_until > hr_from
        if hr_from is not None and 0 < s.coarse_until <= hr_from:
            _log.warning("skips.coarse_until has no effect: HR takes part after iteration %d only.", hr_from)
        elif hr_is_left_out and not any(map(_halves, views)):
            _log.warning(
                "skips.coarse_until has no effect: SR images are halved only where %s is even.",
                "factor" if in_host else "data.views.sr_scale",
            )
        elif hr_is_left_out:
            phrases.append(f"HR at half its size until iteration {s.coarse_until}")
        if hr_is_left_out and s.hr_every > 1:
            phrases.append(
                f"HR in one of {s.hr_every} iterations until iteration {s.coarse_until}, and in each whose scores "
                "densification reads"
            )
        if in_host:
            return phrases
        if s.undrawn > 0:
            phrases.append("Gaussians too faint to be drawn, once densification has ended")
        if s.plateau_gain > 0 and not plateau.measurements:
            _log.debug(
                "skips.plateau_gain has no effect: this run is too short for %d looks at each of %s between two measurements.",
                _LOOKS, counted(len(views), "view"),
            )  # fmt: skip
        elif s.plateau_gain > 0:
            phrases.append(f"all iterations up to {s.plateau_to}, once {plateau}")
        return phrases

    def view(self, view: View, t: int) -> View:
        """The view of iteration t: with a coarse SR image at first, where the factor is even."""
        if t > self.skips.coarse_until:
            self._coarse.clear()  # no later iteration needs them
            return view
        if not _halves(view):
            return view
        whole, coarse = self._coarse.get(view.name, (None, None))
        if coarse is None or whole is not view:  # of another scene, or with another SR image
            coarse = replace(view, hr=view.hr.reduced(_REDUCED), truth=None)
            self._coarse[view.name] = view, coarse
        return coarse

    def leaves_out_hr(self, t: int) -> bool:
        """Return True if HR is left out of iteration t: with `hr_every=2` of even ones, in which pseudo views come, too."""
        return t <= self.skips.coarse_until and (t - 1) % self.skips.hr_every != 0

    def serves_lr(self, view: View) -> bool:
        """Return True if HR at half its size is as large as the photo, so that one render serves both."""
        return view.factor == 1 and view is self._coarse.get(view.name, (None, None))[1]

    def drawn(self, opacities: Float[Tensor, " N"], alpha_min: float) -> Int[Tensor, " M"] | None:
        """The rows of the Gaussians that some view may draw; None where (nearly) all may.

        Args:
            opacities: as rendered. alpha_min: of the rasterizer, see `RasterSettings`.
        """
        if self.skips.undrawn == 0:
            return None
        rows = torch.nonzero(opacities >= _GATED * alpha_min)[:, 0]
        faint = len(opacities) - len(rows)
        if faint < max(1, self.skips.undrawn * len(opacities)) or not len(rows):
            return None
        return rows


def _halves(view: View) -> bool:
    """Return True if the view's SR image has a coarse version that is a whole multiple of the photo."""
    return view.factor % _REDUCED == 0
