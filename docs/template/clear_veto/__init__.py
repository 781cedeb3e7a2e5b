"""Veto: HR gradients that oppose the LR gradient are dropped, attribute by attribute."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from clear_strategies import Grads, Step, Strategy
from clear_strategies.schedules import milestone


@dataclass(frozen=True)
class Veto(Strategy):
    """Drop the HR gradient of a Gaussian where it opposes the LR gradient.

    Args:
        start: first iteration in which gradients are dropped; for a run of 10,000, it stretches with the run.
    """

    start: int = milestone(2_000)

    def correct(self, lr: Grads, hr: Grads, step: Step) -> Grads:
        """g_HR where ⟨g_LR, g_HR⟩ > 0, else 0."""
        if step.t < self.start:
            return hr
        return Grads({name: g * _agrees(g, lr[name]) for name, g in hr.items()})


def _agrees(a: Tensor, b: Tensor) -> Tensor:
    """Whether the rows point the same way, [N, 1, …]."""
    dot = (a * b).flatten(1).sum(1) if a.dim() > 1 else a * b
    return (dot > 0).view(-1, *[1] * (a.dim() - 1))
