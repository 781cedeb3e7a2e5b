"""λ_HR and the learning rate over the iterations, and the milestones that stretch with a run."""

import pytest

from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.merging.objective import Objective
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay, milestones, scaled
from clear_strategies.training.settings import FitSettings


def test_lambda_hr_by_the_papers_milestones_and_the_position_rate():
    schedule = WarmupDecay(final=0.1)
    expected = {1: 0, 500: 0, 501: 1 / 2500, 1750: 0.5, 3000: 1, 5000: 1, 7500: 0.55, 10_000: 0.1, 20_000: 0.1}
    for t, value in expected.items():
        assert schedule(t) == pytest.approx(value), t
    assert WarmupDecay(final=0.1, decay="cosine")(7500) == pytest.approx(0.55)
    assert WarmupDecay(final=0.1, decay="exponential")(7500) == pytest.approx(0.1**0.5)
    rate = LogLinear()
    assert [rate(0), rate(5000), rate(10_000)] == pytest.approx([1.6e-4, 1.6e-5, 1.6e-6])


@pytest.mark.parametrize("weights", [(1, 1), (1, 0), (0, 1), (0, 0)])
@pytest.mark.parametrize("times", [(0, 0, 5, 10), (3, 5, 7, 9), (3, 3, 3, 9), (3, 3, 3, 4), (3, 3, 3, 3)])
def test_where_lambda_is_first_above_0(weights, times):
    peak, final = weights
    schedule = WarmupDecay(peak, final, "linear", *times)
    assert schedule.zero_until == next((t for t in range(20) if schedule(t + 1) > 0), None)


def test_milestones_stretch_with_the_run_and_nothing_else_does():
    short = scaled(Objective(lambda_hr=WarmupDecay(final=0.1)), 0.1)
    assert milestones(short) == {
        "lambda_hr.start": 50, "lambda_hr.full": 300, "lambda_hr.decay_from": 500, "lambda_hr.end": 1000,
    }  # fmt: skip
    assert (short.lambda_hf, short.lambda_hr.final) == (0.2, 0.1)
    assert [short.lambda_hr(t // 10) for t in (500, 1750, 7500)] == pytest.approx([0, 0.5, 0.55])
    assert scaled(Ramp(), 0.5).full == 5000


@pytest.mark.parametrize(("of_10_000", "of_100"), [(3_000, 92), (0, 0)])
def test_opacities_are_not_reset_again_before_they_can_have_returned(of_10_000, of_100):
    assert scaled(DensitySettings(reset_every=of_10_000), 0.01).reset_every == of_100


@pytest.mark.parametrize(("of_10_000", "of_60"), [(20, 1), (2_500, 15), (0, 0)])
def test_a_short_run_does_not_turn_checkpoints_and_evaluations_off(of_10_000, of_60):
    short = scaled(FitSettings(checkpoint_every=of_10_000, probe_every=of_10_000), 60 / 10_000)
    assert (short.checkpoint_every, short.probe_every) == (of_60, of_60)
