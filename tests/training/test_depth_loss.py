"""The depth loss: its gradient, where it counts, and that it moves the field to where stereo saw the surfaces."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from clear_strategies.core.view import DepthMap
from clear_strategies.errors import SettingError
from clear_strategies.training.depth_loss import LOSS, DepthLoss
from clear_strategies.training.loop import iterate
from clear_strategies.training.pseudo_views import PseudoViewSettings
from clear_strategies.training.state import TrainState
from tests.helpers import toy
from tests.helpers.short_run import ITERATIONS, SCENE, start, with_depth


def shot_of(state: TrainState):
    return state.field.shot(toy.RASTERIZER, state.views[0].lr.camera, depth=True)


def known(state: TrainState, depth: float, confidence: float = 1.0) -> DepthMap:
    height, width = state.views[0].lr.image.shape[:2]
    return DepthMap(torch.full((height, width), depth), torch.full((height, width), confidence))


def loss_at(state: TrainState, there: DepthMap, alpha: torch.Tensor) -> float:
    """L_D with α held fixed, as its gradient takes it."""
    shot = shot_of(state)
    shot.alpha = alpha
    return float(DepthLoss(1.0).added(shot, there))


def test_the_gradient_is_that_of_finite_differences():
    state = start((), depth_loss=DepthLoss(1.0))
    there = known(state, 2.0, 0.5)
    shot = shot_of(state)
    alpha = shot.alpha.clone()
    DepthLoss(1.0).added(shot, there)
    (g,) = shot.vjp(torch.zeros(1, *shot.image.shape))
    row = int(g["means"][:, 2].abs().argmax())
    means, h = state.field.means.data, 1e-3
    means[row, 2] += h
    above = loss_at(state, there, alpha)
    means[row, 2] -= 2 * h
    below = loss_at(state, there, alpha)
    assert float(g["means"][row, 2]) == pytest.approx((above - below) / (2 * h), rel=0.02)


def test_the_weight_scales_the_gradient_and_not_the_loss():
    state = start((), depth_loss=DepthLoss(1.0))
    found = []
    for weight in (1.0, 3.0):
        shot = shot_of(state)
        loss = DepthLoss(weight).added(shot, known(state, 2.0))
        found.append((float(loss), shot.vjp(torch.zeros(1, *shot.image.shape))[0]["means"]))
    assert found[0][0] == found[1][0]
    assert torch.allclose(3 * found[0][1], found[1][1], rtol=1e-4, atol=1e-7)


def test_unknown_pixels_do_not_count():
    state = start((), depth_loss=DepthLoss(1.0))
    shot, there = shot_of(state), known(state, float("nan"), 0.0)
    assert float(DepthLoss(1.0).added(shot, there)) == 0
    assert all(not value.any() for value in shot.vjp(torch.zeros(1, *shot.image.shape))[0].values())


@pytest.mark.parametrize("fused", ["auto", "off"])
def test_training_moves_the_field_to_the_depth(fused):
    ends = {}
    for weight in (0.0, 2.0):
        state = start((), depth_loss=DepthLoss(weight), fused=fused)
        for _ in range(ITERATIONS):
            iterate(state, toy.RASTERIZER)
        ends[weight] = float(DepthLoss(1.0).added(shot_of(state), known(state, 4.0)))
        assert all((LOSS in row) == (weight > 0) for row in state.history_as_floats())
    assert ends[2.0] < 0.9 * ends[0.0]


def test_it_takes_part_in_pseudo_views():
    ends = []
    for weight in (0.0, 2.0):
        state = start((), beside=PseudoViewSettings(every=2, count=8, reach=0.1), depth_loss=DepthLoss(weight))
        for _ in range(4):
            iterate(state, toy.RASTERIZER)
        ends.append(state.field.means.clone())
    assert not torch.equal(*ends)


def test_where_it_can_have_no_effect_it_says_so(caplog):
    wanted, scene = DepthLoss(0.1), with_depth(SCENE)

    class Flat(type(toy.RASTERIZER)):
        traits = replace(toy.RASTERIZER.traits, depth=False)

    assert wanted.of_run(scene, toy.RASTERIZER, draws_lr=True) == wanted
    assert not caplog.text
    for said, found in (
        ("no training photo has stereo depth", wanted.of_run(SCENE, toy.RASTERIZER, draws_lr=True)),
        ("the rasterizer Flat draws no depth", wanted.of_run(scene, Flat(), draws_lr=True)),
        ("the run renders no LR", wanted.of_run(scene, toy.RASTERIZER, draws_lr=False)),
    ):
        assert found.weight == 0
        assert said in caplog.text


def test_a_negative_weight_is_refused():
    with pytest.raises(SettingError, match="weight must be >= 0, got -1"):
        DepthLoss(-1.0)
