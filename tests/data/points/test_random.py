"""Random points: inside their box, decided by the seed."""

from __future__ import annotations

import torch

from clear_strategies.data.points import CloudSettings, initial_points
from clear_strategies.data.points.random import random_cloud
from tests.helpers.planes import photo


def test_points_fill_the_given_box_with_near_grey() -> None:
    cloud = random_cloud([photo()], 10_000, seed=0, box=1.3)
    assert cloud.means.shape == (10_000, 3)
    assert 1.25 < float(cloud.means.max()) <= 1.3
    assert -1.3 <= float(cloud.means.min()) < -1.25
    assert (cloud.colors - 0.5).abs().max() <= 0.05
    assert cloud.uses_test_views == "no"
    assert cloud.source == "random: 10,000 points in [-1.3, 1.3]³"


def test_the_same_seed_gives_the_same_points() -> None:
    one, two, other = (random_cloud([photo()], 10, seed, 1.0).means for seed in (0, 0, 1))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)


def test_nothing_is_removed_from_or_added_to_random_points() -> None:
    assert (
        len(initial_points(CloudSettings(init="random", random_points=777, outlier_ratio=0.1), [photo()]).cloud) == 777
    )
