"""Strategies that learn from what the field shows: two fields, methods of two stages, two subsets of a field."""

import logging
from dataclasses import replace

import pandas as pd
import pytest
import torch

from clear_strategies import MCMC, Conductor, ExtraView, Objective, PairDrop, SRStage, TwoFields
from clear_strategies.core import images
from clear_strategies.density.shuffle import ShuffleSettings
from clear_strategies.merging.skips import Skips
from clear_strategies.outputs import results
from clear_strategies.strategies.base import Drawn
from clear_strategies.strategies.two_fields import distances
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import EXTRA_LOSS, iterate
from clear_strategies.training.optim import Adam, LearningRates
from rasterizers import Camera
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


def test_the_second_conductor_has_a_state_of_its_own_and_without_the_lr_loss_there_is_no_effect():
    conductor = Conductor(MCMC(growth=0.1), EVERY, skips=Skips(plateau_gain=0.1), statistics_from=7)
    copy = conductor.copy()
    assert copy.strategies == conductor.strategies
    assert all(
        a is not b and a.state is not b.state for a, b in zip(copy.strategies, conductor.strategies, strict=True)
    )
    assert (copy.skips.skips.plateau_gain, copy.statistics_from) == (0.0, 7)
    assert copy.work_log is conductor.work_log
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


# ---- methods of two stages: the Shuffle Split, and what the second stage trains on
AT_10 = ShuffleSettings(start=20, stop=20, split_at=10, min_gaussians=1)


def field_of(opacities: list[float]) -> tuple[GaussianField, Adam]:
    theta = GaussianField.from_cloud(toy.cloud(len(opacities)))
    theta.opacities.data[:] = torch.logit(torch.tensor(opacities))
    theta.scales.data[:] = torch.log(torch.tensor([0.4, 0.2, 0.1]))
    theta.quats.data[:] = torch.tensor([2**-0.5, 0, 0, 2**-0.5])  # x turns to y
    return theta, Adam(theta.raw(), LearningRates(), extent=1.0)


def test_an_opaque_gaussian_becomes_six_thinner_ones_once_and_the_cap_leaves_the_most_opaque():
    theta, optimizer = field_of([0.3, 0.84, 0.4])
    density, parents = AT_10.densifier(3, extent=1.0, seed=0, white_background=False), []
    before = theta.means.data.clone()
    assert [density.step(theta, optimizer, t, parents.append) for t in (9, 10, 11)] == [False, True, False]
    assert parents[0].tolist() == [0, 2, *[1] * 6]
    aside = theta.means.data[2:] - before[1]
    expected = torch.tensor([[0, -0.2, 0], [0, 0.2, 0], [0.1, 0, 0], [-0.1, 0, 0], [0, 0, -0.05], [0, 0, 0.05]])
    assert torch.allclose(aside, expected, atol=1e-6)
    assert torch.allclose(theta.scales.data[2].exp(), torch.tensor([0.4 / 4, 0.2 / 1.9, 0.1 / 1.9]))
    assert torch.allclose(theta.opacities.data[2:].sigmoid(), torch.tensor(0.6))  # two of them are as opaque as one was
    assert len(density.score) == len(theta) == 8
    assert density.second_stage == 11
    theta, optimizer = field_of([0.6, 0.7, 0.9, 0.8])
    settings = ShuffleSettings(start=20, stop=20, split_at=10, min_gaussians=1, max_gaussians=14)
    density, parents = settings.densifier(4, extent=1.0, seed=0, white_background=False), []
    density.step(theta, optimizer, 12, parents.append)  # skips may jump over t=10
    assert parents[0].tolist() == [0, 1, *[2, 3] * 6]
    resumed = settings.densifier(14, extent=1.0, seed=0, white_background=False)
    resumed.load_state_dict(density.state_dict())
    assert not resumed.step(theta, optimizer, 13, parents.append)


def staged(settings: SRStage) -> SRStage:
    Conductor(settings).on_fit_start(3, 3, views=SCENE.train)
    return settings


def looked_at(seen: list[Camera]) -> Drawn:
    def draw(camera, gate=None):
        seen.append(camera)
        return torch.full((camera.height, camera.width, 3), 0.25)

    return Drawn(SCENE.cloud.means, draw, lambda image, factor: images.upsample(image, factor, "nearest"))


def test_sr_images_and_enlarged_pictures_of_the_first_stage_come_in_turn(caplog):
    stage, seen = staged(SRStage(start=4, count=5)), []
    shown = [stage.drawn_views(t, looked_at(seen)) for t in range(1, 15)]
    assert [len(views) for views in shown] == [0] * 4 + [1] * 10
    assert len(seen) == 5  # drawn once, at LR
    assert {camera.width for camera in seen} == {SCENE.train[0].lr.camera.width}
    of_photos = {id(view.hr) for view in SCENE.train}
    for t, (extra,) in enumerate(shown[4:], 5):
        assert extra.robust
        assert (id(extra.photo) in of_photos) == bool(t % 2)
        assert extra.photo.camera.width == SCENE.train[0].hr.camera.width
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        staged(SRStage(start=4, count=5)).drawn_views(9, looked_at([]))
    assert "draws its pictures at t=9, not at t=5" in caplog.text


def test_a_robust_picture_counts_less_where_the_field_contradicts_it():
    grey = torch.full((32, 32, 3), 0.5)
    noisy = grey + 0.02 * torch.randn(32, 32, 3, generator=torch.Generator().manual_seed(0))
    noisy[:8, :8] = 1.0
    weight = images.agreement(noisy, grey)
    assert weight.shape == (32, 32, 1)
    assert float(weight[:6, :6].max()) < 0.05
    assert float(weight[12:, 12:].min()) > 0.5
    assert float(images.agreement(grey, grey).min()) == 1
    photo = SCENE.train[0].lr
    conductor, one = Conductor(objective=Objective(kernels="torch")), torch.ones(photo.image.shape[:2])
    render = torch.rand(photo.image.shape, generator=torch.Generator().manual_seed(1))
    plain, robust = (conductor.extra_loss(render, ExtraView(photo, one, robust=r), 1).cotangents for r in (False, True))
    assert torch.allclose(robust, plain * images.agreement(render, photo.image))


def test_timing_has_iterations_and_seconds_of_both_stages():
    state, history = start(()), pd.DataFrame({"t": range(1, 6), "seconds": [2.0, 4.0, 6.0, 8.0, 10.0]})
    assert results._two_stages(state, history) == []
    state.t, state.density = 6, replace(AT_10, split_at=2).densifier(3, extent=1.0, seed=0, white_background=False)
    assert [(row["runs"], row["seconds"]) for row in results._two_stages(state, history)] == [(2, 4.0), (3, 6.0)]


# ---- two dropped subsets of a field, compared at a size that shows low frequencies alone
def test_one_subset_learns_what_another_shows_of_a_training_view():
    state = start(("gco",), more=[PairDrop(share=0.5, start=4)])
    for _ in range(8):
        iterate(state, toy.RASTERIZER)
    rows = state.history_as_floats()
    assert [int(row["t"]) for row in rows if EXTRA_LOSS in row] == [4, 6, 8]
    assert all(row[EXTRA_LOSS] > 0 for row in rows if EXTRA_LOSS in row)
    strategy, gates = state.conductor.strategies[-1], []

    def draw(camera, gate):
        gates.append(gate)
        assert camera.width == SCENE.train[0].lr.camera.width // 2
        return torch.zeros(camera.height, camera.width, 3)

    (extra,) = strategy.drawn_views(4, Drawn(state.field.means.data, draw, lambda image, factor: image))
    assert not torch.equal(extra.gate(50), gates[0](50))
