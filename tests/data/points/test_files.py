"""Points from files: PLY files, SfM points, and those of them that enough training views observe."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from clear_strategies.data.points import CloudSettings, initial_points
from clear_strategies.data.points.files import from_tracks
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
