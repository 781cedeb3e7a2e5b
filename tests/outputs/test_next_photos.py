"""The next photo shows what too few photos show, and is not one that shows nothing they know."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch

from clear_strategies.outputs.next_photos import NextPhoto, next_photos
from tests.helpers import wall


def advised(*x: float, count: int = 2) -> Sequence[NextPhoto]:
    return next_photos({f"photo{i}": wall.at(place) for i, place in enumerate(x)}, wall.painter(), count)


def test_it_stands_where_one_photo_alone_shows_the_wall():
    """Three photos at the left show the same part; most of what the fourth shows no other photo does."""
    (only,) = advised(-2.6, -2.4, -2.2, 2.4, count=1)
    assert "photo3" in only.where
    assert float(only.camera.center[0]) > -2.2


def test_it_is_worth_most_where_one_photo_looks_from_the_same_side_and_nothing_where_three_do():
    middle = slice(15, 25), slice(20, 40)
    (second,) = advised(0.0, count=1)
    (fourth,) = advised(-0.02, 0.0, 0.02, count=1)
    assert float(second.worth[middle].mean()) > 0.75
    assert float(fourth.worth[middle].mean()) < 0.4


def test_the_second_is_chosen_as_if_the_first_had_been_taken():
    (alone,), both = advised(0.0, 0.4, count=1), advised(0.0, 0.4)
    assert torch.equal(alone.camera.world_to_camera, both[0].camera.world_to_camera)
    assert not torch.equal(both[0].camera.world_to_camera, both[1].camera.world_to_camera)


def test_without_a_surface_there_is_no_advice():
    nothing = wall.painter()
    nothing.field.opacities.data -= 20
    assert next_photos({"a": wall.at(0.0), "b": wall.at(1.0)}, nothing) == []


@pytest.mark.parametrize("photos", [(0.0,), (-1.0, 1.5)])
def test_its_words_name_the_side_on_which_it_stands(photos):
    for photo in advised(*photos, count=5):
        x, y, _ = (float(value) for value in photo.camera.center)
        beside = photos[int(photo.where[-1])]
        if "between" in photo.where:
            assert min(photos) <= x <= max(photos)
            continue
        side = {"right": x > beside + 1e-5, "left": x < beside - 1e-5, "above": y < -1e-5, "below": y > 1e-5}
        assert [word for word in side if word in photo.where] == [word for word, holds in side.items() if holds]
        assert 0 <= float(photo.worth.nan_to_num(0).min()) <= float(photo.worth.nan_to_num(0).max()) <= 1
        assert photo.gain == pytest.approx(float(photo.worth.nanmean()))
