"""The HR side is held to a number of megapixels: the factor, the photos and the words for each size of photo."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.data.capture import Capture
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.hr_limit import within_limit
from clear_strategies.data.prepare import prepare
from clear_strategies.data.priors import Bicubic
from clear_strategies.data.view_settings import ViewSettings
from tests.helpers.captures import in_a_row


def held(size: tuple[int, int], *, super_resolve: bool = False, **settings) -> tuple[Capture, ViewSettings]:
    return within_limit(
        in_a_row(size, size), ViewSettings(**settings), reaches=lambda _: True, super_resolve=super_resolve
    )


@pytest.mark.parametrize(
    ("size", "photos_are", "factor"),
    [
        ((360, 240), "lr", 4),  # 1440x960
        ((776, 516), "lr", 2),  # 1552x1032
        ((960, 540), "lr", 2),  # 1920x1080
        ((1008, 756), "both", 4),
        ((4032, 3024), "both", 4),
    ],
)
def test_every_size_of_photo_keeps_the_hr_side_within_the_limit(size, photos_are, factor):
    found, views = held(size)
    camera = found.frames[0].camera
    scale = views.sr_scale if views.photos_are == "lr" else 1
    assert (views.photos_are, views.sr_scale) == (photos_are, factor)
    assert scale**2 * camera.width * camera.height <= 2.1e6 * 1.01
    if size[0] * size[1] <= 2.1e6:
        assert (camera.width, camera.height) == size  # every pixel is used


def test_a_prior_that_is_chosen_super_resolves_reduced_photos():
    found, views = held((4032, 3024), super_resolve=True)
    camera = found.frames[0].camera
    assert (views.photos_are, views.sr_scale) == ("lr", 2) or views.sr_scale == 4
    assert 16 * camera.width * camera.height == pytest.approx(2.1e6, rel=0.01)


def test_without_a_limit_and_under_the_protocols_nothing_changes():
    for settings in ({"max_hr_megapixels": None}, {"photos_are": "hr"}, {"photos_are": "both"}):
        found, views = held((4032, 3024), **settings)
        assert found.frames[0].camera.width == 4032
        assert "HR side" not in found.notes
        assert views == ViewSettings(**settings)


def test_photos_of_two_sizes_are_each_reduced_to_the_limit_and_trained_on_at_both_scales():
    views = ViewSettings(max_hr_megapixels=0.004)
    found, views = within_limit(
        in_a_row((100, 80), (80, 100), (50, 40)), views, reaches=lambda _: True, super_resolve=False
    )
    sizes = [(frame.camera.width, frame.camera.height) for frame in found.frames]
    assert sizes == [(72, 56), (56, 72), (48, 40)]
    scene = prepare(found, views, Bicubic(), CloudSettings(init="random", random_points=20))
    assert len(scene.train) == 3
    for view in scene.train:
        assert torch.equal(view.hr.image, view.truth)
        assert (view.lr.camera.width * 4, view.lr.camera.height * 4) == (view.hr.camera.width, view.hr.camera.height)
        assert "the photos themselves" in view.sr_source
    assert scene.notes["test views"].startswith("none")
