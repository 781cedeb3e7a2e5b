"""This package's trainer on a scene, for hosts whose steps must equal its own."""

from __future__ import annotations

import rasterizers
from clear_strategies import Conductor
from clear_strategies.data.scene import Scene
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.schedules import LogLinear
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState

RASTERIZER = rasterizers.load("torch", near=0.01, kernel=0.3, antialiased=False)


def in_double(scene: Scene, conductor: Conductor, steps: int, eps: float = 1e-15) -> TrainState:
    """Before its first step, in float64: otherwise Adam follows the sign of gradients that consist of rounding errors."""
    state = TrainState.start(
        scene, conductor, settings=FitSettings(iterations=steps, degree_every=1, fused="off", scale_schedule=False),
        density=DensitySettings(start=1_000, stop=1_001),
        rates=LearningRates(means=LogLinear(1.6e-4, 1.6e-4, 1), eps=eps), mip=MipFilter(variance=0),
    )  # fmt: skip
    state.field.double()
    adam = state.optimizer
    adam.first, adam.second = ({k: v.double() for k, v in moments.items()} for moments in (adam.first, adam.second))
    return state
