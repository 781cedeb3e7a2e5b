"""Replayed iterations, on the CPU: the bits of the live ones, and every reason to be live."""

from dataclasses import dataclass

import pytest
import torch

import clear_strategies as cs
import rasterizers
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.density.mcmc import MCMC
from clear_strategies.kernels.per_gaussian import dispatch
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay
from clear_strategies.training import checkpoint
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


@pytest.fixture(autouse=True)
def _kernels_of_warp(monkeypatch):
    monkeypatch.setattr(dispatch, "DEVICES", {"cpu"})


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
    if replayed and state.replays is None:
        state.replays = replays_for(state, rasterizer)
    while state.t <= until:
        iterate(state, rasterizer)
    return state


def require_same(found: TrainState, expected: TrainState) -> None:
    of_both = tensors(found), tensors(expected)
    assert of_both[0].keys() == of_both[1].keys()
    assert not [name for name, x in of_both[0].items() if not torch.equal(x, of_both[1][name])]
    assert without_time(found.history_as_floats()) == without_time(expected.history_as_floats())
    assert skipped(found) == skipped(expected)


def skipped(state: TrainState) -> dict[str, dict[str, int]]:
    return {stage: entry.skipped for stage, entry in state.conductor.work_log.entries.items() if entry.skipped}


@pytest.mark.slow
@pytest.mark.parametrize("moves", ["density", "mcmc"])
def test_five_hundred_replayed_iterations_have_the_bits_of_live_ones(moves):
    def best():
        more = [cs.PseudoViews(count=8, reach=0.1), cs.FadingOpacity(rate=0.002), cs.RandomBackground(until=1_350)]
        return start(*more, *([MCMC(start=50, stop=300, every=ROUND, per_point=3.0)] if moves == "mcmc" else []))

    live, replayed = (trained(best(), replayed=r, until=500) for r in (False, True))
    require_same(replayed, live)
    assert live.conductor.work_log.state_dict().keys().isdisjoint({"replayed"})
    assert replays_of(replayed) > 600  # of 500 views and 250 extra views
    assert len(live.field) > 12


def test_replays_have_the_bits_of_live_iterations_also_after_resuming(tmp_path):
    live, replayed = (trained(start(density=False), replayed=r, until=12) for r in (False, True))
    require_same(replayed, live)
    assert replays_of(replayed) == 12 - 3  # nothing is dropped at t=1, t=2 is live, and t=3 is recorded
    path = checkpoint.save(tmp_path, replayed.checkpoint({}))
    resumed = start(density=False)
    resumed.restore(checkpoint.load(path), path)
    require_same(*(trained(state, replayed=state is not live, until=20) for state in (resumed, live)))


def test_where_lists_are_too_short_the_iteration_is_live_and_recorded_anew():
    live, replayed = start(density=False), start(density=False)
    for state in (live, replayed):
        state.field.scales.data -= 3.0
        trained(state, replayed=state is replayed, until=8)
        state.field.scales.data += 3.0
        trained(state, replayed=state is replayed, until=12)
    require_same(replayed, live)
    assert replays_of(replayed) == 5 + 1 + 2  # t=9 ends at the count, and t=10 is recorded


def test_where_a_graph_cannot_be_recorded_all_iterations_are_live(monkeypatch, caplog):
    live, other = (trained(start(density=False), replayed=r, until=2) for r in (False, True))

    def fails(*_):
        raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr("clear_strategies.training.replay.Recording", fails)
    other.replays._device = torch.device("cuda")  # where what is recorded has not been done yet
    require_same(trained(other, replayed=True, until=6), trained(live, replayed=False, until=6))
    assert caplog.text.count("could not be recorded, so that all are live from now on: operation not permitted") == 1


def replays_of(state: TrainState) -> int:
    return state.conductor.work_log.entries["replayed"].runs


@dataclass(frozen=True)
class Routes(cs.P2G):
    """A P2G that somebody has changed."""

    def route(self, step):
        return super().route(step) * step.t


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda s: setattr(s, "compiled_step", None), "the per-Gaussian step is not that of Warp"),
        (lambda s: setattr(s.conductor, "objective", cs.Objective(kernels="torch")), "losses are not those of Warp"),
        (lambda s: setattr(s.conductor, "strategies", (Routes(),)), "Routes does not state what it looks up of a view"),
    ],
)
def test_what_cannot_be_recorded_is_live_and_the_log_says_why(change, reason, caplog):
    state = start()
    change(state)
    assert replays_for(state, rasterizers.load("warp", device="cpu")) is None
    assert reason in caplog.text


def test_other_rasterizers_are_not_recorded(caplog):
    assert replays_for(start(), rasterizers.load("torch")) is None
    assert "ReferenceRasterizer cannot be recorded; rasterizer=warp can" in caplog.text
