"""FadingOpacity: which share of its opacity a Gaussian loses, when, and how many views slow it down."""

from dataclasses import replace

import pytest
import torch

from clear_strategies import FadingOpacity, Step
from clear_strategies.schedules import scaled
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.loop import iterate
from tests.helpers.short_run import SCENE, start, tensors
from tests.helpers.toy import RASTERIZER

LOGITS = torch.tensor([-20.0, -11.6, -11.4, -5.0, 0.0, 3.0, 15.0])


def faded(settings, t=1, views=3, opacities=LOGITS):
    strategy = replace(settings)
    strategy.on_fit_start(views, seed=0)
    params = {"opacities": opacities.clone(), "means": torch.ones(len(opacities), 3)}
    strategy.after_step(params, Step(t, SCENE.train[0], None, None))
    return params


def test_every_opacity_loses_the_same_share_but_one_that_no_renderer_draws_so_that_logits_stay_finite():
    params = faded(FadingOpacity(rate=0.02))
    visible = LOGITS > -11.5
    expected = LOGITS.double().sigmoid() * 0.98
    assert torch.allclose(params["opacities"].double().sigmoid()[visible], expected[visible], rtol=1e-6)
    assert torch.equal(params["means"], torch.ones(len(LOGITS), 3))
    params = {"opacities": torch.tensor([-200.0, -11.6, 2.0])}
    strategy = FadingOpacity(rate=0.5)
    strategy.on_fit_start(3, seed=0)
    for t in range(1, 1000):
        strategy.after_step(params, Step(t, SCENE.train[0], None, None))
    assert params["opacities"][:2].tolist() == [-200.0, pytest.approx(-11.6)]
    assert -13 < params["opacities"][2] <= -11.5


@pytest.mark.parametrize(
    ("views", "until", "most", "rate"),
    [
        (1, 9_000, 0, 0.02), (3, 9_000, 0, 0.02), (6, 9_000, 0, 0.01), (12, 9_000, 0, 0.005), (3, 1_350, 0, 0.02),
        (3, 270, 0, 0.004), (3, 1_350, 1_350, 0.02), (3, 270, 1_350, 0.004), (3, 2_700, 1_350, 0.01),
        (6, 2_700, 1_350, 0.01), (12, 2_700, 1_350, 0.005), (3, 27_000, 1_350, 0.001),
    ],
)  # fmt: skip
def test_the_more_views_and_the_shorter_or_with_a_bound_the_longer_the_run_the_slower_it_fades(
    views, until, most, rate
):
    lost = 1 - faded(FadingOpacity(rate=0.02, until=until, most=most), views=views)["opacities"][4].sigmoid() / 0.5
    assert float(lost) == pytest.approx(rate, rel=1e-4)


def test_after_nine_tenths_of_the_run_and_without_a_rate_opacities_are_left_alone():
    short = scaled(FadingOpacity(), 0.15)
    assert not torch.equal(faded(short, t=1350)["opacities"], LOGITS)
    assert torch.equal(faded(short, t=1351)["opacities"], LOGITS)
    assert torch.equal(faded(FadingOpacity(rate=0.0))["opacities"], LOGITS)


def test_a_run_fades_and_every_row_has_the_bits_of_the_pass_that_skips_some():
    states = {
        name: start(("gco", "svs"), more=more)
        for name, more in (
            ("plain", ()), ("fading", (FadingOpacity(rate=0.05),)), ("every row", (FadingOpacity(rate=0.05),)),
        )
    }  # fmt: skip
    every_row = states["every row"]
    every_row.compiled_step = CompiledStep(every_row.conductor, every_row.optimizer, skips=False)
    for state in states.values():
        while not state.ended:
            iterate(state, RASTERIZER)
    plain, fading, visited = (tensors(state) for state in states.values())
    assert fading["field/opacities"].sigmoid().mean() < 0.9 * plain["field/opacities"].sigmoid().mean()
    assert all(torch.equal(value, visited[name]) for name, value in fading.items())
