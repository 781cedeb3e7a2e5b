"""A densifier by a strategy of gsplat's shape, on a field whose every tensor carries its Gaussian's number."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from clear_strategies import Update
from clear_strategies.core.gradients import Grads
from clear_strategies.density.gsplat import GsplatDensifier, GsplatSettings
from clear_strategies.strategies.testing import StubShot
from clear_strategies.training.densifier import Densifier
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam, LearningRates
from tests.helpers import toy

DEFAULT, MCMC, TINY_ONE = (
    "gsplat.strategy.DefaultStrategy",
    "clear_strategies.density.mcmc.MCMC",
    "tests.helpers.gsplat_like.Tiny",
)
KINDS = [TINY_ONE, DEFAULT, MCMC]
N = 12


def need(target: str) -> str:
    """The dotted name, where what it names can be imported."""
    if "gsplat_like" not in target:
        pytest.importorskip("gsplat", reason="gsplat is not installed: pip install 'clear-strategies[gsplat]'")
    return target


def settings(target: str, strategy: dict[str, Any] | None = None, **changes: Any) -> GsplatSettings:
    """A round every iteration, from the first."""
    own = {"_target_": need(target), **(strategy or {})}
    shared = {"start": 0, "stop": 100, "every": 1, "statistics_from": 0, "min_gaussians": 1, "reset_every": 0}
    return GsplatSettings(own, **{**shared, **changes})


def tagged(target: str = TINY_ONE, strategy: dict[str, Any] | None = None, **changes: Any):
    """A field whose every tensor carries its Gaussian's number, with optimizer and the strategy's own state alike."""
    theta = GaussianField.from_cloud(toy.cloud(N))
    number = torch.arange(N, dtype=torch.float32)
    for name in ("detail", "quats"):
        getattr(theta, name).data[:] = number[:, None] + 1
    theta.filter_3d = number + 1
    optimizer = Adam(theta.raw(), LearningRates(), extent=1.0)
    for moments in (*optimizer.first.values(), *optimizer.second.values()):
        moments[:] = number.view(-1, *[1] * (moments.dim() - 1)) + 1
    made = settings(target, strategy, **changes).densifier(N, extent=1.0, seed=0, white_background=False)
    assert isinstance(made, GsplatDensifier)
    return theta, optimizer, made


def look(made: Densifier, score, ordinary=None, *, t: int = 1, seen=None) -> None:
    """One view, 64x48, whose score is given."""
    ordinary = score if ordinary is None else ordinary
    seen = torch.ones(N, dtype=torch.bool) if seen is None else seen
    shot = StubShot(torch.zeros(48, 64, 3), torch.zeros(len(seen), 2), seen, [])
    made.accumulate(Update(toy.step(), Grads(), score, ordinary), shot, t)


def grown(made: Densifier, theta: GaussianField, optimizer: Adam, t: int = 1) -> list[int]:
    """Which rows got more structure."""
    told: list[torch.Tensor] = []
    made.step(theta, optimizer, t, told.append)
    return [] if not told else (torch.bincount(told[0], minlength=N) > 1).nonzero()[:, 0].tolist()
