"""The rates of the detail feature f_det, which every trainer needs and no host has."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.errors import counted
from clear_strategies.schedules import LARGEST_RATE

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DetailRates:
    """Learning rate and decay of f_det.

    Args:
        rate: learning rate of Adam for f_det, an offset of RGB (F34).
        steps: a run of fewer iterations gives f_det a share of its rate in proportion; 0: always the whole rate. In RGB, f_base
            moves at 0.28 of the rate of its SH coefficients, and a short run ends before it has followed f_det.
        decay: share of f_det, in [0, 1), that is lost at every step in which HR takes part. L_HF does not change with a
            constant colour, so nothing else keeps f_det near 0; the paper has none, 0 (F35).

    Raises:
        SettingError: a setting is outside its range.
    """

    rate: float = 2.5e-3
    steps: int = 1_500
    decay: float = 0.002

    def __post_init__(self) -> None:
        require_number("detail", self.rate, most=LARGEST_RATE)
        require_number("detail_decay", self.decay, below=1)
        require_whole("detail_steps", self.steps, least=0)

    def of_run(self, iterations: int) -> DetailRates:
        """The rates of a run of this length; see `steps`."""
        if iterations >= self.steps:
            return self
        rate = self.rate * iterations / self.steps
        _log.debug(
            "f_det learns at a rate of %.2g instead of %.2g: the run has %s (optim.detail_steps: %d).",
            rate, self.rate, counted(iterations, "iteration"), self.steps,
        )  # fmt: skip
        return replace(self, rate=rate)
