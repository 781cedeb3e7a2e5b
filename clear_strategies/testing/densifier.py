"""The part of the contract that a strategy with a densifier of its own keeps, in a training of a few iterations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from clear_strategies.core.step import Step
from clear_strategies.strategies.base import Strategy
from clear_strategies.testing import given
from clear_strategies.testing.given import Make, without_error
from clear_strategies.training.field import GaussianField
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers.testing import require


def check_densifier_takes_everything_along(make: Make) -> None:
    """A densifier of its own gathers field and optimizer alike and says how, keeps to its cap, is reproducible, and goes on from
    its `state_dict`.
    """
    whole, again = ([*_densified(make)] for _ in range(2))
    for a, b in zip(whole, again, strict=True):
        require(torch.equal(a, b), "two runs of a densifier with one seed differ; derive randomness from (seed, t)")
    for cut in range(2, given.STEPS) if whole else ():
        for a, b in zip(whole, _densified(make, cut), strict=True):
            require(torch.equal(a, b), f"cut before t={cut}: a densifier's state_dict() does not continue the run")


@dataclass(frozen=True)
class _Rows(Strategy):
    """Knows after a change of structure from which row each comes."""

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        self.state["row"] = torch.arange(float(len(params["means"])))


def _densified(make: Make, cut: int = 0) -> Iterator[Tensor]:
    """All parameters after each iteration of a run that is resumed before t=cut; nothing where the trainer densifies."""
    state = _begun(make)
    while state is not None and state.t < given.STEPS:
        if state.t == cut:
            saved, state = state.checkpoint({}), cast(TrainState, _begun(make))
            state.restore(saved, Path("checkpoint"))
        t, field, density, conductor = state.t, state.field, state.density, state.conductor
        lr, hr, view, _ = given.situation(100 + t, len(field))
        update = conductor.update(field.raw(), lr, hr, view, t)
        state.optimizer.step(field.raw(), update.grads or {})
        if density.collects(t):
            before = replace(update, grads=None)  # as from `Conductor.gradients`
            without_error("a densifier's accumulate", f"at t={t}", density.accumulate, before, hr, t)
        conductor.after_step(field.raw(), update.step)
        state.optimizer.first["opacities"].copy_(torch.arange(1, len(field) + 1))
        if conductor.may_densify(t):
            without_error("a densifier's step", f"at t={t}", state.restructure)
        momentum, n = state.optimizer.first["opacities"], len(field)
        came_from = conductor.state_dict()["_Rows.row"]
        follows = len(momentum) == n and bool(((momentum == came_from + 1) | (momentum == 0)).all())
        require(follows, f"a densifier's step must gather the optimizer as the field, by optimizer.take(…), at t={t}")
        most = n if density.cap is None else max(density.cap, given.N)
        require(n <= most, f"a densifier's cap is {density.cap}, but the field has {n} Gaussians at t={t}")
        state.advance()
        yield from (p.clone() for p in field.raw().values())


def _begun(make: Make) -> TrainState | None:
    """A run before its first iteration; None where the strategy brings no densifier."""
    view, g = given.situation(0)[2], torch.Generator().manual_seed(0)
    conductor = given.conductor(make, others=[_Rows()], views=[view])
    if (owner := conductor.owner("densifier")) is None:
        return None
    field = GaussianField(given.random_params(given.N, g))
    density = without_error("densifier", "at the start", owner.densifier, field, [view], 11)
    if density is None:
        return None
    optimizer = Adam(field.raw(), LearningRates(), 1.0)
    return TrainState(field, conductor, optimizer, density, FitSettings(), MipFilter(), (view,))
