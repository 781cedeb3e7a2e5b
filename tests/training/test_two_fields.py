"""Two fields: each learns from what the other shows, and the first is the run's."""

from __future__ import annotations

import logging

import pytest
import torch

from clear_strategies import MCMC, Conductor, TwoFields
from clear_strategies.merging.skips import Skips
from clear_strategies.strategies.base import Drawn
from clear_strategies.strategies.two_fields import distances
from clear_strategies.training.loop import EXTRA_LOSS, iterate
from tests.helpers import toy
from tests.helpers.short_run import SCENE, start

EVERY = TwoFields(every=1, start=1)


def drawn_at(means: torch.Tensor, seen: list) -> Drawn:
    def draw(camera, gate=None):
        seen.append(camera)
        return torch.zeros(camera.height, camera.width, 3)

    return Drawn(means, draw, lambda image, factor: image)


def prepared(settings: TwoFields = EVERY, seed: int = 3) -> TwoFields:
    conductor = Conductor(settings)
    conductor.on_fit_start(3, seed, views=SCENE.train)
    return settings


def test_a_second_field_of_another_seed_trains_along_and_no_third():
    state = start((), more=[EVERY])
    second = state.second
    assert (state.other, second.other, second.second) == (second, state, None)
    assert second.settings.seed not in (state.settings.seed, state.settings.seed + 1)
    for _ in range(6):
        iterate(state, toy.RASTERIZER)
        assert (second.t, second.optimizer.steps, len(second.history)) == (state.t, state.optimizer.steps, 0)
    assert not torch.equal(state.field.means.data, second.field.means.data)
    assert all(EXTRA_LOSS in row for row in state.history)
    assert start(()).second is None


def test_each_is_shown_the_other_by_a_camera_beside_the_training_cameras():
    strategy, seen = prepared(TwoFields(every=2, start=4, size=2, weight=0.5)), []
    drawn = drawn_at(SCENE.cloud.means, seen)
    shown = [strategy.drawn_views(t, drawn) for t in range(1, 9)]
    assert [len(views) for views in shown] == [0, 0, 0, 1, 0, 1, 0, 1]
    extra = shown[3][0]
    assert (extra.photo.camera.width, float(extra.weight.max())) == (2 * SCENE.train[0].lr.camera.width, 0.5)
    assert len({tuple(camera.center.tolist()) for camera in seen}) == 3
    again = prepared(strategy).drawn_views(4, drawn)[0].photo.camera
    assert torch.equal(again.world_to_camera, extra.photo.camera.world_to_camera)


def test_what_is_alone_becomes_invisible_where_fields_are_compared():
    strategy = prepared(TwoFields(start=1, alone=0.1, compare_every=5, compare_until=10))
    others = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    means = torch.cat((others[:5] + 0.01, torch.full((1, 3), 50.0)))
    for t, hidden in ((4, False), (5, True), (15, False)):
        opacities = torch.zeros(6)
        strategy.drawn_views(t, drawn_at(others, []))
        strategy.after_step({"means": means, "opacities": opacities}, toy.step(t))
        assert (opacities < -5).tolist() == [False] * 5 + [hidden], t
    assert torch.allclose(distances(means, others)[:5], torch.tensor(0.01 * 3**0.5), atol=1e-5)


def test_the_second_conductor_has_the_settings_and_a_state_of_its_own():
    conductor = Conductor(MCMC(growth=0.1), EVERY, skips=Skips(plateau_gain=0.1), statistics_from=7)
    copy = conductor.copy()
    assert copy.strategies == conductor.strategies
    assert all(
        a is not b and a.state is not b.state for a, b in zip(copy.strategies, conductor.strategies, strict=True)
    )
    assert (copy.skips.skips.plateau_gain, copy.statistics_from) == (0.0, 7)
    assert copy.work_log is conductor.work_log


def test_without_the_lr_loss_it_says_that_it_has_no_effect():
    assert "lambda_lr is 0" in TwoFields().without_effect(lambda_lr=0, lambda_hr=1, lambda_hf=0)
    assert TwoFields().without_effect(lambda_lr=1, lambda_hr=1, lambda_hf=0) is None
    assert TwoFields().summary() is None
    assert "every 2 iterations" in prepared(TwoFields()).summary()


@pytest.mark.parametrize("fused", ["auto", "off"])
def test_both_paths_train_both(fused, caplog):
    caplog.set_level(logging.INFO)
    state = start(("gco",), more=[EVERY], fused=fused)
    for _ in range(3):
        iterate(state, toy.RASTERIZER)
    assert (state.second.compiled_step is None) == (fused == "off")
