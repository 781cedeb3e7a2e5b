"""Extra views: each gets a step of the optimizer on the LR loss, weighted by pixel, besides that of the iteration's view."""

from dataclasses import dataclass

import pytest
import torch

from clear_strategies import SVS, Conductor, ExtraView, Objective, Photo, Strategy
from clear_strategies.core import deferred
from clear_strategies.errors import DivergedError
from clear_strategies.training.loop import EXTRA_LOSS, extra_steps, iterate
from clear_strategies.training.state import TrainState
from tests.helpers import toy
from tests.helpers.short_run import ITERATIONS, SCENE, start


def dark(every: int = 2) -> toy.Shows:
    """Shows the field a black picture at every `every`-th iteration."""
    return toy.Shows(lambda views, t: () if t % every else (black(),))


@dataclass(frozen=True)
class Red(Strategy):
    def background(self, t):
        return 1.0, 0.0, 0.0


def black(weight: float = 1.0) -> ExtraView:
    photo = SCENE.train[0].lr
    return toy.again(Photo(photo.camera, torch.zeros_like(photo.image)), weight)


def parameters(state: TrainState) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in state.field.raw().items()}


def test_they_come_when_a_strategy_says_so_and_are_compared_before_the_background():
    state = start((), more=[dark()])
    for _ in range(ITERATIONS):
        iterate(state, toy.RASTERIZER)
    rows = state.history_as_floats()
    assert [int(row["t"]) for row in rows if EXTRA_LOSS in row] == list(range(2, ITERATIONS + 1, 2))
    assert all(row[EXTRA_LOSS] > 0 for row in rows if EXTRA_LOSS in row)
    assert state.conductor.work_log.entries["extra views"].runs == ITERATIONS // 2
    white = (1.0, 1.0, 1.0)
    photo = Photo(toy.camera(0.0, 24, 16), torch.ones(16, 24, 3), transparency=torch.ones(16, 24))
    conductor = Conductor(Red(), objective=Objective(kernels="torch"))
    render = torch.tensor([1.0, 0.0, 0.0]).expand(16, 24, 3)
    loss = conductor.extra_loss(render, ExtraView(photo, torch.ones(16, 24), white), 1)
    assert float(loss.cotangents.abs().max()) < 1e-12


def test_every_strategy_is_asked_unless_there_is_no_lr_loss_and_the_weight_scales_the_gradient():
    conductor = start((), more=[dark(), dark(every=3)]).conductor
    assert len(conductor.extra_views(6)) == 2
    object.__setattr__(conductor.objective, "lambda_lr", 0.0)
    assert conductor.extra_views(6) == []
    state = start((), fused="off")
    extra, shot = black(), state.field.shot(toy.RASTERIZER, black().photo.camera)
    whole = state.conductor.extra_loss(shot.image, extra, 1).cotangents
    third = state.conductor.extra_loss(shot.image, black(weight=0.25), 1).cotangents
    assert torch.equal(third, 0.25 * whole)


@pytest.mark.parametrize("fused", ["auto", "off"])
def test_only_weighted_pixels_teach_no_anchor_pulls_and_the_learning_rates_follow_the_iteration(fused):
    state = start((), more=[SVS(anchor_strength=0.1, anchor_weights={"scales": 1.0}, anchor_start=1)], fused=fused)
    state.conductor.strategies[0].state["scales"] = state.field.scales.data + 1.0
    before, steps = parameters(state), state.optimizer.steps
    row = extra_steps(state, toy.RASTERIZER, [black(weight=0.0)])
    assert deferred.resolve([row])[0][EXTRA_LOSS] == 0
    assert all(torch.equal(value, before[name]) for name, value in state.field.raw().items())
    extra_steps(state, toy.RASTERIZER, [black(), black()])
    assert state.conductor.work_log.entries["extra views"].runs == 3
    moved = {name for name, value in state.field.raw().items() if not torch.equal(value, before[name])}
    assert {"means", "scales", "opacities", "sh0"} <= moved
    assert "detail" not in moved
    assert state.optimizer.steps == steps


def test_the_readable_and_the_compiled_step_agree():
    ends = []
    for fused in ("auto", "off"):
        state = start((), fused=fused)
        for _ in range(4):
            state.optimizer.steps += 1  # an iteration's own step has come before
            extra_steps(state, toy.RASTERIZER, [black()])
        ends.append(parameters(state))
    for name in ("means", "scales", "opacities", "sh0"):  # quats of round Gaussians have gradients of rounding noise
        assert torch.allclose(ends[0][name], ends[1][name], rtol=1e-3, atol=1e-5), name


@pytest.mark.parametrize("fused", ["auto", "off"])
def test_a_number_that_is_not_finite_is_found_before_the_step(fused):
    state, extra = start((), fused=fused), black()
    extra.photo.image[3, 4] = torch.nan
    before = parameters(state)
    with pytest.raises(DivergedError, match="t=1, an extra view"):
        extra_steps(state, toy.RASTERIZER, [extra])
    assert all(torch.equal(value, before[name]) for name, value in state.field.raw().items())
