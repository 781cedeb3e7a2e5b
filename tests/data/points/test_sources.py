"""Points of files, SfM points that enough training views observe, and random points inside their box."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from clear_strategies.data.points import CloudSettings, from_tracks, initial_points, random_cloud
from clear_strategies.errors import DataError
from tests.helpers.planes import photo, sfm


@pytest.mark.parametrize(
    ("ids", "min_views", "kept"),
    [([1, 2, 3], 2, [0, 2]), ([1, 2, 3], 3, [0]), ([1, 9], 2, [1]), ([1], 1, [0, 1]), ([1, 2, 3], 1, [0, 1, 2])],
)
def test_points_observed_by_enough_training_views_are_kept(ids: list[int], min_views: int, kept: list[int]) -> None:
    cloud = from_tracks(sfm(), ids, min_views)
    assert torch.equal(cloud.means, sfm().means[kept])
    assert torch.equal(cloud.colors, sfm().colors[kept])


def test_sfm_points_are_marked_as_using_test_views_filtered_or_not() -> None:
    for init in ("sfm", "sfm_train"):
        cloud = initial_points(CloudSettings(init=init, densify=False), [photo()], sfm=sfm(), train_ids=[1, 2, 3]).cloud
        assert cloud.uses_test_views == "yes"
        assert "all of sparse/0" in cloud.source


def test_missing_points_are_refused_in_one_line() -> None:
    with pytest.raises(DataError, match="none is observed by 4 of the 3 training views"):
        from_tracks(sfm(), [1, 2, 3], 4)
    none = torch.zeros(0, dtype=torch.long)
    with pytest.raises(DataError, match="come without tracks"):
        from_tracks(replace(sfm(), track_point=none, track_image=none), [1], 1)
    with pytest.raises(DataError, match="there are none, but init=sfm_train"):
        initial_points(CloudSettings(init="sfm_train"), [photo()])


def test_points_fill_the_given_box_with_near_grey() -> None:
    cloud = random_cloud([photo()], 10_000, seed=0, box=1.3)
    assert cloud.means.shape == (10_000, 3)
    assert 1.25 < float(cloud.means.max()) <= 1.3
    assert -1.3 <= float(cloud.means.min()) < -1.25
    assert (cloud.colors - 0.5).abs().max() <= 0.05
    assert cloud.uses_test_views == "no"
    assert cloud.source == "random: 10,000 points in [-1.3, 1.3]³"
    one, other = (random_cloud([photo()], 10_000, seed, 1.3).means for seed in (0, 1))
    assert torch.equal(one, cloud.means)
    assert not torch.equal(other, cloud.means)


def test_nothing_is_removed_from_or_added_to_random_points() -> None:
    settings = CloudSettings(init="random", random_points=777, outlier_ratio=0.1)
    assert len(initial_points(settings, [photo()]).cloud) == 777
