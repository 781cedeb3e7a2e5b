"""A step on a pseudo view: where its colours are known, for the LR loss, beside the iteration's own step."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import torch

from clear_strategies.core import deferred
from clear_strategies.core.view import DepthMap
from clear_strategies.errors import DivergedError, SettingError
from clear_strategies.geometry.pseudo_views import PseudoView
from clear_strategies.training import pseudo_views
from clear_strategies.training.loop import iterate
from clear_strategies.training.pseudo_views import LOSS, PseudoViews, PseudoViewSettings
from clear_strategies.training.state import TrainState
from tests.helpers import toy
from tests.helpers.short_run import ITERATIONS, SCENE, start, with_depth

BESIDE = PseudoViewSettings(every=2, count=8, reach=0.1)


def parameters(state: TrainState) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in state.field.raw().items()}


def blank(state: TrainState, known: bool) -> PseudoView:
    """One view whose colours are black, known everywhere or nowhere."""
    photo = state.views[0].lr
    black = replace(photo, image=torch.zeros_like(photo.image))
    everywhere = torch.full(photo.image.shape[:2], known)
    return PseudoView(black, DepthMap(torch.ones_like(everywhere, dtype=torch.float32), everywhere.float()))


def test_steps_come_every_nth_iteration_and_their_loss_is_in_the_history():
    state = start((), beside=BESIDE)
    for _ in range(ITERATIONS):
        iterate(state, toy.RASTERIZER)
    rows = state.history_as_floats()
    assert [int(row["t"]) for row in rows if LOSS in row] == list(range(2, ITERATIONS + 1, 2))
    assert all(row[LOSS] > 0 for row in rows if LOSS in row)
    assert state.conductor.work_log.entries["pseudo view"].runs == ITERATIONS // 2


def test_every_pseudo_view_has_its_turn_and_the_choice_is_a_function_of_seed_and_iteration():
    made = PseudoViews.of(with_depth(SCENE), BESIDE, seed=5)
    chosen = [made.due(t, 5) for t in range(2, 400, 2)]
    assert {id(view) for view in chosen} == {id(view) for view in made.views}
    assert chosen == [made.due(t, 5) for t in range(2, 400, 2)]
    assert chosen != [made.due(t, 6) for t in range(2, 400, 2)]
    assert made.due(3, 5) is None


@pytest.mark.parametrize("fused", ["auto", "off"])
def test_only_known_pixels_teach_and_the_learning_rates_follow_the_iteration(fused):
    state = start((), beside=BESIDE, fused=fused)
    before, steps = parameters(state), state.optimizer.steps
    loss = pseudo_views.step(state, toy.RASTERIZER, blank(state, known=False))
    assert float(deferred.resolve([{"loss": loss}])[0]["loss"]) == 0
    assert all(torch.equal(value, before[name]) for name, value in state.field.raw().items())
    pseudo_views.step(state, toy.RASTERIZER, blank(state, known=True))
    moved = {name for name, value in state.field.raw().items() if not torch.equal(value, before[name])}
    assert {"means", "scales", "opacities", "sh0"} <= moved
    assert "detail" not in moved
    assert state.optimizer.steps == steps


def test_the_readable_and_the_compiled_step_agree():
    ends = []
    for fused in ("auto", "off"):
        state = start((), beside=BESIDE, fused=fused)
        for _ in range(4):
            state.optimizer.steps += 1  # an iteration's own step has come before
            pseudo_views.step(state, toy.RASTERIZER, blank(state, known=True))
        ends.append(parameters(state))
    for name in ("means", "scales", "opacities", "sh0"):  # quats of round Gaussians have gradients of rounding noise
        assert torch.allclose(ends[0][name], ends[1][name], rtol=1e-3, atol=1e-5), name


def test_a_dark_pseudo_view_darkens_the_field():
    state = start((), beside=BESIDE)
    view = blank(state, known=True)
    losses = []
    for _ in range(30):
        state.optimizer.steps += 1
        losses.append(pseudo_views.step(state, toy.RASTERIZER, view))
    read = deferred.resolve([{"loss": loss} for loss in losses])
    assert read[-1]["loss"] < 0.8 * read[0]["loss"]


def test_a_scene_without_depth_is_warned_of_and_trains_without():
    state = start((), beside=BESIDE)
    with_none = PseudoViews.of(SCENE, BESIDE, seed=5)
    assert state.pseudo_views.says() is not None
    assert with_none.due(2, 5) is None
    assert with_none.says() is None


def test_the_warning_names_the_remedy(caplog):
    with caplog.at_level(logging.WARNING):
        PseudoViews.of(SCENE, BESIDE, seed=5)
    assert "data.cloud.init=stereo" in caplog.text
    caplog.clear()
    PseudoViews.of(SCENE, PseudoViewSettings(), seed=5)
    assert not caplog.text


def test_without_an_lr_loss_they_have_no_effect_and_the_warning_says_so(caplog):
    assert PseudoViews.of(with_depth(SCENE), BESIDE, seed=5, lambda_lr=0).says() is None
    assert "lambda_lr is 0" in caplog.text


@pytest.mark.parametrize("fused", ["auto", "off"])
def test_a_number_that_is_not_finite_is_found_before_the_step(fused):
    state = start((), beside=BESIDE, fused=fused)
    view = blank(state, known=True)
    view.photo.image[3, 4] = torch.nan
    before = parameters(state)
    with pytest.raises(DivergedError, match="t=1, a pseudo view"):
        pseudo_views.step(state, toy.RASTERIZER, view)
    assert all(torch.equal(value, before[name]) for name, value in state.field.raw().items())


def test_an_object_cut_out_of_its_surroundings_needs_none(caplog):
    white = [
        replace(view, lr=replace(view.lr, image=torch.where(torch.arange(24)[None, :, None] < 12, view.lr.image, 1.0)))
        for view in SCENE.train
    ]
    scene = with_depth(replace(SCENE, train=tuple(white), background=(1.0, 1.0, 1.0)))
    with caplog.at_level(logging.INFO):
        assert PseudoViews.of(scene, BESIDE, seed=5).says() is None
    assert "plain background" in caplog.text
    assert PseudoViews.of(replace(scene, background=(0.5, 0.5, 0.5)), BESIDE, seed=5).says() is not None


@pytest.mark.parametrize(
    "bad", [{"every": -1}, {"count": 0}, {"reach": 0.0}, {"weight": 0.0}, {"tolerance": -1.0}, {"max_pixels": 0}]
)
def test_a_setting_outside_its_range_is_refused(bad):
    with pytest.raises(SettingError, match=next(iter(bad))):
        PseudoViewSettings(**bad)
