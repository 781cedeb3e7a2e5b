"""Replayed iterations, on the CPU: the bits of the live ones, and every reason to be live."""

from collections import Counter

import pytest
import torch

import clear_strategies as cs
import rasterizers
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.density.mcmc import MCMC
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.loop import iterate
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.replay import replays_for
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from tests.helpers.backends import needs
from tests.helpers.short_run import SCENE, tensors, with_depth
from tests.training.test_resume import without_time

pytestmark = needs("warp")
ROUND = 50  # iterations between changes of the structure


def start(*more, iterations=500, density=True) -> TrainState:
    """A training of everything that `best` is made of, over which λ_HR rises and falls, and with an anchor."""
    from clear_strategies.kernels.gaussian_step.warp import WarpGaussianStep

    objective = cs.Objective(
        lambda_hr=WarmupDecay(final=0.1, start=20, full=60, decay_from=400, end=500), kernels="warp"
    )
    svs = cs.SVS(dropout=Ramp(full=200), looks=0, anchor_start=300, anchor_strength=0.01, anchor_weights={"means": 1.0})
    conductor = cs.Conductor(cs.GCO(), cs.P2G(), svs, *more, objective=objective, statistics_from=1)
    state = TrainState.start(
        with_depth(SCENE), conductor,
        settings=FitSettings(iterations=iterations, scale_schedule=False, degree_every=150, seed=5),
        density=DensitySettings(
            start=1, stop=300 if density else 2, statistics_from=1, every=ROUND, reset_every=120, threshold=1e-5, max_gaussians=80
        ),
        rates=LearningRates(means=LogLinear(end=500), detail_decay=0.01, cool_from=450, end=500),
        mip=MipFilter(every=15, last=1),
    )  # fmt: skip
    state.compiled_step = CompiledStep(conductor, state.optimizer, passes=WarpGaussianStep)
    return state


def trained(state: TrainState, *, replayed: bool, until: int) -> TrainState:
    rasterizer = rasterizers.load("warp", device="cpu")
    state.replays = replays_for(state, rasterizer) if replayed else None
    while state.t <= until:
        iterate(state, rasterizer)
    return state


def require_same(found: TrainState, expected: TrainState) -> None:
    of_both = tensors(found), tensors(expected)
    assert of_both[0].keys() == of_both[1].keys()
    assert not [name for name, x in of_both[0].items() if not torch.equal(x, of_both[1][name])]
    assert without_time(found.history_as_floats()) == without_time(expected.history_as_floats())
    assert Counter(found.conductor.work_log.state_dict()["optimizer rows"]["skipped"]) == Counter(
        expected.conductor.work_log.state_dict()["optimizer rows"]["skipped"]
    )


@pytest.mark.slow
@pytest.mark.parametrize("moves", ["density", "mcmc"])
def test_five_hundred_replayed_iterations_have_the_bits_of_live_ones(moves):
    def best():
        more = [cs.PseudoViews(count=8, reach=0.1), cs.FadingOpacity(rate=0.002), cs.RandomBackground(until=1_350)]
        return start(*more, *([MCMC(start=50, stop=300, every=ROUND, per_point=3.0)] if moves == "mcmc" else []))

    live, replayed = (trained(best(), replayed=r, until=500) for r in (False, True))
    require_same(replayed, live)
    replays = replayed.conductor.work_log.state_dict()["replayed"]["runs"]
    assert replays > 300
    assert len(live.field) > 12
