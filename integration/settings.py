"""The settings of `install`, the same in every host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from clear_strategies.core.checks import require_choice
from clear_strategies.data.priors import Images
from clear_strategies.errors import SettingError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.schedules import REFERENCE_ITERATIONS
from integration.views import Points, SuperResolve


@dataclass(frozen=True, slots=True)
class Settings:
    """The strategies, the SR images, and the initial points.

    Args:
        strategies: names of conf/strategy: "clear", "gco", "gco,svs" …
        overrides: settings, e.g. "strategies.gco.tolerance=0.1", "objective=lr_only".
        sr: the folder of the SR images, or a function that makes them; None: there are none, for strategies and objectives that
            do not use HR. suffix: what the SR tool appended to the names.
        factor: HR pixels per LR pixel.
        points: "own": the Gaussians start as the host makes them; "stereo": from dense stereo between its training photos.
        seed: of the strategies.
        hr_by: what draws HR in a gsplat-style host, see `integration.gsplat.attach`; other hosts draw it themselves.
        accumulation: see `integration.host.Host`.

    Raises:
        SettingError: `points` is neither of these.
    """

    strategies: str = "clear"
    overrides: Sequence[str] = ()
    sr: SuperResolve | str | Path | None = None
    suffix: str = ""
    factor: int = 4
    points: Points = "own"
    seed: int = 0
    hr_by: str = "auto"
    accumulation: int = 1

    def __post_init__(self) -> None:
        require_choice("points", self.points, get_args(Points))

    def conductor(self, iterations: int = REFERENCE_ITERATIONS) -> Conductor:
        """The strategies, with milestones for a training of so many iterations.

        Raises:
            SettingError: a name or a setting is refused.
        """
        from clear_strategies.compose import conductor  # brings Hydra

        return conductor(self.strategies, *self.overrides, iterations=iterations)

    def sr_source(self, conductor: Conductor) -> tuple[SuperResolve, int]:
        """The prior of the SR images, with the conductor's decorators around it, and their factor. Without SR images, HR is LR.

        Raises:
            SettingError: there are no SR images, but the objective or a strategy needs them.
        """
        if self.sr is not None:
            sr = Images(str(self.sr), self.suffix) if isinstance(self.sr, str | Path) else self.sr
            return conductor.prior(sr), self.factor
        if conductor.uses_hr:
            raise SettingError(
                "sr: must be the folder of the SR images, got None, but HR is used. Pass the folder (save_lr writes the "
                "photos for an SR tool), or set objective=lr_only and leave P2G out."
            )
        return lambda name, image, factor: image, 1
