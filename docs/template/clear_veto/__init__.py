"""Veto: HR gradients that oppose the LR gradient are dropped, attribute by attribute."""

from __future__ import annotations

from dataclasses import dataclass

from clear_strategies import Products, Step, Strategy, Weights
from clear_strategies.schedules import milestone


@dataclass(frozen=True)
class Veto(Strategy):
    """Drop the HR gradient of a Gaussian where it opposes the LR gradient.

    Args:
        start: first iteration in which gradients are dropped; for a run of 10,000, it stretches with the run.
    """

    start: int = milestone(2_000)

    def reconcile(self, products: Products, step: Step | None) -> Weights:
        """Keep g_HR where ⟨g_LR, g_HR⟩ > 0, by Gaussian and attribute."""
        if step is not None and step.t < self.start:
            return Weights()
        return Weights(keep=products.dot > 0)
