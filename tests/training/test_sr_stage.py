"""Methods of two stages: the Shuffle Split, and what the second stage trains on."""

import logging
from dataclasses import dataclass, replace

import pandas as pd
import torch

from clear_strategies import Conductor, ExtraView, Objective, Photo, SRStage, Strategy
from clear_strategies.core import images
from clear_strategies.density.shuffle import ShuffleSettings
from clear_strategies.outputs import results
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import EXTRA_LOSS, iterate
from clear_strategies.training.optim import Adam, LearningRates
from rasterizers import Camera
from tests.helpers import toy
from tests.helpers.short_run import SCENE, start

AT_10 = ShuffleSettings(start=20, stop=20, split_at=10, min_gaussians=1)


def field_of(opacities: list[float]) -> tuple[GaussianField, Adam]:
    theta = GaussianField.from_cloud(toy.cloud(len(opacities)))
    theta.opacities.data[:] = torch.logit(torch.tensor(opacities))
    theta.scales.data[:] = torch.log(torch.tensor([0.4, 0.2, 0.1]))
    theta.quats.data[:] = torch.tensor([2**-0.5, 0, 0, 2**-0.5])  # x turns to y
    return theta, Adam(theta.raw(), LearningRates(), extent=1.0)


def test_an_opaque_gaussian_becomes_six_thinner_ones_once_and_the_cap_leaves_the_most_opaque():
    theta, optimizer = field_of([0.3, 0.84, 0.4])
    density, parents = toy.densifier(AT_10, theta), []
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
    density, parents = toy.densifier(settings, theta), []
    density.step(theta, optimizer, 12, parents.append)  # skips may jump over t=10
    assert parents[0].tolist() == [0, 1, *[2, 3] * 6]
    density.score[3] = 7
    resumed = toy.densifier(settings, theta)
    resumed.load_state_dict(density.state_dict())
    assert torch.equal(resumed.score, density.score)
    assert not resumed.step(theta, optimizer, 13, parents.append)


def staged(settings: SRStage) -> SRStage:
    Conductor(settings).on_fit_start(3, 3, views=SCENE.train)
    return settings


def test_sr_images_and_enlarged_pictures_of_the_first_stage_come_in_turn(caplog):
    stage, seen = staged(SRStage(start=4, count=5)), []

    def enlarged(camera: Camera, factor: int) -> Photo:
        seen.append(camera)
        large = camera.scaled(factor)
        return Photo(large, torch.full((large.height, large.width, 3), 0.25))

    shown = []
    for t in range(1, 15):
        stage.draw(t, SCENE.cloud.means, enlarged)
        shown.append(stage.extra_views(t))
    assert [len(views) for views in shown] == [0] * 4 + [1] * 10
    assert len(seen) == 5  # drawn once, at LR
    assert {camera.width for camera in seen} == {SCENE.train[0].lr.camera.width}
    of_photos = {id(view.hr) for view in SCENE.train}
    for t, (extra,) in enumerate(shown[4:], 5):
        assert extra.robust
        assert (id(extra.photo) in of_photos) == bool(t % 2)
        assert extra.photo.camera.width == SCENE.train[0].hr.camera.width
    Conductor(stage).on_fit_end()
    assert not stage.extra_views(15)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        staged(SRStage(start=4, count=5)).draw(9, SCENE.cloud.means, enlarged)
    assert "draws its pictures at t=9, not at t=5" in caplog.text


def test_the_trainer_draws_what_the_field_shows_and_steps_on_it():
    state, before = start((), more=[SRStage(start=3, count=2)]), []
    for _ in range(6):
        before.append(state.field.baked())
        iterate(state, toy.RASTERIZER)
    assert [EXTRA_LOSS in row for row in state.history] == [False] * 3 + [True] * 3
    for photo in state.conductor.strategies[-1].cache["pictures"]:
        image = images.area_mean(photo.image, SCENE.train[0].factor)
        exact = toy.RASTERIZER(before[3], photo.camera.scaled(1 / SCENE.train[0].factor)).image
        assert float((image - exact).abs().mean()) < 0.05


def test_any_strategy_draws_the_field_by_a_camera_of_its_own_before_its_extra_views():
    @dataclass(frozen=True)
    class Remembers(Strategy):
        def draw(self, t, means, enlarged):
            self.cache[t] = [enlarged(SCENE.test[0].lr.camera, factor) for factor in (1, 2)]

        def extra_views(self, t):
            plain, large = (photo.image for photo in self.cache[t])
            assert torch.allclose(images.upsample(images.quantize(plain), 2), large, atol=0.01)
            return [ExtraView(self.cache[t][0], torch.ones(plain.shape[:2]))]

    state = start((), more=[Remembers()])
    iterate(state, toy.RASTERIZER)
    assert state.history[0][EXTRA_LOSS] < 0.01  # it shows itself


def test_a_robust_picture_counts_less_where_the_field_contradicts_it():
    photo = SCENE.train[0].lr
    conductor, one = Conductor(objective=Objective(kernels="torch")), torch.ones(photo.image.shape[:2])
    render = torch.rand(photo.image.shape, generator=torch.Generator().manual_seed(1))
    plain, robust = (conductor.extra_loss(render, ExtraView(photo, one, robust=r), 1).cotangents for r in (False, True))
    assert torch.allclose(robust, plain * images.agreement(render, photo.image))


def test_hidden_pixels_do_not_decide_how_far_a_robust_picture_is_trusted():
    photo, conductor = SCENE.train[0].lr, Conductor(objective=Objective(kernels="torch", lambda_ssim=0.0))
    whole = torch.ones(photo.image.shape[:2])
    partly, shown = whole.clone(), photo.camera.width * 6 // 10
    partly[:, :shown] = 0
    nothing = torch.zeros_like(whole)
    of_whole, of_part, of_nothing = (
        conductor.extra_loss(photo.image + 0.1, ExtraView(photo, weight, robust=True), 1).cotangents
        for weight in (whole, partly, nothing)
    )
    inner = slice(shown + 2, None)  # the windows of these show no hidden pixel
    assert torch.allclose(of_part[:, :, inner], of_whole[:, :, inner])
    assert not of_nothing.any()


def test_timing_has_iterations_and_seconds_of_both_stages():
    state, history = start(()), pd.DataFrame({"t": range(1, 6), "seconds": [2.0, 4.0, 6.0, 8.0, 10.0]})
    assert results._two_stages(state, history) == []
    state.t, state.density = 6, toy.densifier(replace(AT_10, split_at=2), 3)
    assert [(row["runs"], row["seconds"]) for row in results._two_stages(state, history)] == [(2, 4.0), (3, 6.0)]
