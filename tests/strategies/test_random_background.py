"""RandomBackground: which colours, when, and for which photos none."""

from dataclasses import replace

import pytest
import torch

from clear_strategies import Photo, RandomBackground
from clear_strategies.training.loop import iterate, view_at
from tests.helpers.short_run import SCENE, start
from tests.helpers.toy import RASTERIZER


def prepared(views=SCENE.train, seed=5, until=1_350):
    strategy = RandomBackground(until=until)
    strategy.on_fit_start(len(views), seed)
    strategy.on_views(views)
    return strategy


def test_every_iteration_has_its_own_colour_a_function_of_the_seed_and_the_last_ones_that_of_the_scene():
    colors = [prepared().background(t) for t in range(1, 41)]
    assert len(set(colors)) == 40
    assert colors == [prepared().background(t) for t in range(1, 41)]
    assert colors[0] != prepared(seed=6).background(1)
    assert torch.tensor(colors).mean(0).sub(0.5).abs().max() < 0.2
    assert prepared().background(1_351) is None


@pytest.mark.parametrize(
    ("views", "until", "why"),
    [(SCENE.train[:1] * 6, 1_350, "more than 5 training views"), (SCENE.train, 1_349, "fewer than 1,350 iterations")],
)
def test_many_views_and_short_runs_keep_the_background_and_say_so(views, until, why):
    kept = prepared(views, until=until)
    assert kept.background(1) is None
    assert why in kept.summary()
    without_views = RandomBackground(until=until)
    without_views.on_fit_start(len(views), 5)
    without_views.on_views(())  # this loop does not have them at the start
    assert without_views.summary() == kept.summary()
    assert "another colour in each of the first 1,350" in prepared().summary()


def test_what_the_photos_show_behind_an_object_or_hide_stays_as_it_is():
    white = [
        replace(view, lr=Photo(view.lr.camera, torch.ones_like(view.lr.image)), background=(1.0, 1.0, 1.0))
        for view in SCENE.train
    ]
    assert prepared(white).background(1) is None
    assert "not transparent" in prepared(white).summary()
    hiding = [v.hiding(torch.arange(v.lr.camera.width).expand(v.lr.image.shape[:2]) > 3) for v in SCENE.train]
    assert prepared(hiding).background(1) is None


def test_an_object_before_transparency_gets_other_backgrounds_however_many_views_there_are():
    height, width = SCENE.train[0].lr.image.shape[:2]
    behind = torch.arange(width).expand(height, width) >= width // 2

    def cut_out(transparency):
        image = torch.where(behind[..., None], 1.0, 0.5).expand(-1, -1, 3)
        photo = replace(SCENE.train[0].lr, image=image, transparency=transparency)
        return [replace(SCENE.train[0], lr=photo, background=(1.0, 1.0, 1.0))] * 6

    assert prepared(cut_out(behind.float())).background(1) is not None
    assert prepared(cut_out(torch.zeros(height, width))).background(1) is None  # the white is painted


def test_the_trainer_renders_over_it_and_evaluates_over_the_background_of_the_scene():
    state = start((), more=[RandomBackground(until=1_350)])
    state.field.opacities.data.fill_(-15.0)  # the background is all that is seen
    view = view_at(state)
    iterate(state, RASTERIZER)
    color = torch.tensor(state.conductor.background(1))
    psnr = -10 * float((color - view.lr.image).square().mean().log10())
    assert state.history_as_floats()[0]["psnr_train_lr"] == pytest.approx(psnr, abs=1e-3)
    assert float(state.field.render(RASTERIZER, view.lr.camera).max()) < 1e-4


def test_the_trainer_compares_transparent_photos_over_the_colour_that_it_renders_over():
    state = start((), more=[RandomBackground(until=1_350)])
    state.field.opacities.data.fill_(-5.0)  # nearly nothing but the background
    empty = [
        replace(view, **{
            scale: replace(photo, image=torch.zeros_like(photo.image), transparency=torch.ones(photo.image.shape[:2]))
            for scale, photo in (("lr", view.lr), ("hr", view.hr))
        })
        for view in state.views
    ]  # fmt: skip
    state.views = empty
    for _ in range(4):  # HR counts from the fourth
        iterate(state, RASTERIZER)
    row = state.history_as_floats()[-1]
    assert row["psnr_train_lr"] > 40
    assert max(row["loss_lr"], row["loss_base"]) < 0.02
