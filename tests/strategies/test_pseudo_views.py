"""PseudoViews: which pictures it shows the field, when, and where it shows none."""

import logging
from dataclasses import replace

import torch

from clear_strategies import PseudoViews
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.prepare import prepare
from clear_strategies.data.priors import Bicubic
from clear_strategies.data.readers import demo
from clear_strategies.data.view_settings import ViewSettings
from tests.helpers.short_run import SCENE, with_depth

FEW = PseudoViews(count=8, reach=0.1)


def prepared(views=None, settings=FEW, seed=5):
    views = with_depth(SCENE).train if views is None else views
    strategy = replace(settings)
    strategy.on_fit_start(len(views), seed)
    strategy.on_views(views)
    return strategy


def test_large_photos_get_fewer_views_so_that_all_of_them_fit_into_memory(monkeypatch):
    photo = SCENE.train[0].lr.camera
    monkeypatch.setattr("clear_strategies.geometry.depth_maps", None)  # these views have depth
    monkeypatch.setattr("clear_strategies.strategies.pseudo_views._TOGETHER", 3 * photo.width * photo.height)
    summary = prepared().summary()
    assert summary.startswith("3 beside the training cameras")
    assert "1 with a field 1.3 times as wide" in summary


def test_one_comes_every_nth_iteration_and_the_choice_is_a_function_of_seed_and_iteration():
    made = prepared()
    assert [len(made.extra_views(t)) for t in range(1, 7)] == [0, 1, 0, 1, 0, 1]
    chosen = [made.extra_views(t)[0] for t in range(2, 400, 2)]
    assert len({id(view) for view in chosen}) == 8 + len(SCENE.train)  # each has its turn
    assert chosen == [made.extra_views(t)[0] for t in range(2, 400, 2)]
    again, other = ([s.extra_views(t)[0].photo.image for t in range(2, 9, 2)] for s in (prepared(), prepared(seed=6)))
    first = [view.photo.image for view in chosen[:4]]
    assert all(torch.equal(a, b) for a, b in zip(again, first, strict=True))
    assert not all(a.shape == b.shape and torch.equal(a, b) for a, b in zip(other, first, strict=True))


def test_a_view_is_made_when_it_is_first_shown_and_is_the_same_whichever_were_made_before(monkeypatch):
    made, shown = [], prepared()
    target = PseudoViews._target
    monkeypatch.setattr(PseudoViews, "_target", lambda *of: made.append(1) or target(*of))
    late = prepared()
    assert not made
    last = late.extra_views(40)[0]
    assert len(made) == 1
    for t in range(2, 40, 2):
        shown.extra_views(t)
    assert torch.equal(last.photo.image, shown.extra_views(40)[0].photo.image)


def test_a_quarter_are_training_cameras_with_a_wider_field():
    made = prepared()
    width = SCENE.train[0].lr.camera.width
    wide = [made.extra_views(t)[0].photo.camera.width > width for t in range(2, 802, 2)]
    assert 60 < sum(wide) < 140
    for off in ({"border": 1.0}, {"continued": 0.0}):
        none = prepared(settings=replace(FEW, **off))
        assert all(none.extra_views(t)[0].photo.camera.width == width for t in range(2, 100, 2))


def test_the_weight_is_that_of_the_settings_where_photos_tell_the_colour_and_small_or_none_elsewhere():
    made = prepared(settings=replace(FEW, weight=0.5, continued=0.2))
    extras = [made.extra_views(t)[0] for t in range(2, 60, 2)]
    assert {round(w, 6) for extra in extras for w in extra.weight.unique().tolist()} == {0.1, 0.5}
    black = (extras[0].photo.image == 0).all(-1)
    assert not black.any()
    extra = prepared(settings=replace(FEW, weight=0.5, continued=0.0)).extra_views(2)[0]
    assert set(extra.weight.unique().tolist()) <= {0.0, 0.5}
    assert not extra.photo.image[extra.weight == 0].any()


def test_views_without_depth_get_it_from_stereo_and_without_it_only_the_borders_are_shown(caplog):
    made = prepared(SCENE.train[:1])
    assert "only shows the borders of the photos" in caplog.text
    extra = made.extra_views(2)[0]
    assert extra.photo.camera.width > SCENE.train[0].lr.camera.width
    assert (made.summary() or "").startswith("1 with a field 1.3 times as wide")
    assert prepared(SCENE.train[:1], replace(FEW, border=1.0)).summary() is None
    capture = demo.read(width=128, height=96, views=6, train=3)
    scene = prepare(
        capture, ViewSettings(train=3, photos_are="hr"), Bicubic(), CloudSettings(init="random", random_points=10)
    )
    assert all(view.depth is None for view in scene.train)
    made = prepared(scene.train)
    assert "8 beside the training cameras" in (made.summary() or "")


def test_without_views_and_after_the_run_there_are_none(caplog):
    made = prepared(())
    assert "PseudoViews has no effect: this training loop does not give its views" in caplog.text
    assert not made.extra_views(2)
    made = prepared()
    made.on_fit_end()
    assert made.summary() is None
    assert not made.extra_views(2)


def test_an_object_cut_out_of_its_surroundings_needs_none(caplog):
    left = torch.arange(24)[None, :, None] < 12
    cut_out = [replace(view.lr, image=torch.where(left, view.lr.image, 1.0)) for view in SCENE.train]
    white = tuple(replace(v, lr=lr, background=(1.0, 1.0, 1.0)) for v, lr in zip(SCENE.train, cut_out, strict=True))
    views = with_depth(replace(SCENE, train=white)).train
    with caplog.at_level(logging.INFO):
        assert prepared(views).summary() is None
    assert "plain background" in caplog.text
    assert prepared([replace(view, background=(0.5, 0.5, 0.5)) for view in views]).summary() is not None
