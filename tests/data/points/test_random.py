"""Random points: inside their box, decided by the seed; the cameras' common box."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies.core.view import Photo
from clear_strategies.data.points import CloudSettings, initial_points
from clear_strategies.data.points.projection import project
from clear_strategies.data.points.random import common_box, random_cloud
from rasterizers.interface import Camera
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


def test_cameras_around_an_object_have_the_ball_that_they_all_see_in_common() -> None:
    photos = []
    for k in range(8):
        c, s = math.cos(k * math.pi / 4), math.sin(k * math.pi / 4)
        pose = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 4], [0, 0, 0, 1.0]])
        photos.append(Photo(Camera(pose, 100.0, 100.0, 50.0, 40.0, 100, 80), torch.zeros(80, 100, 3)))
    low, high = common_box(photos)
    half = 4 * math.sin(math.atan(0.4))  # the narrow side: 40 px of 100
    assert torch.allclose(low, torch.full((3,), -half), atol=0.01)
    assert torch.allclose(high, torch.full((3,), half), atol=0.01)


def test_parallel_cameras_have_a_box_ahead_in_common() -> None:
    low, high = common_box([photo(-1.0), photo(1.0)])
    middle = (low + high) / 2
    assert torch.allclose(middle, torch.tensor([0.0, 0, 10]), atol=0.1)
    pixels, depth = project(photo(0.0).camera, middle[None])
    assert depth > 0
    assert torch.allclose(pixels, torch.full((1, 2), 20.0).double(), atol=0.1)


@given(st.integers(1, 4), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_a_common_box_is_finite_and_has_a_volume(count: int, seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    photos = []
    for _ in range(count):
        rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=g))
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation * torch.linalg.det(rotation), torch.randn(3, generator=g)
        photos.append(Photo(Camera(pose, 100.0, 100.0, 20.0, 20.0, 40, 40), torch.zeros(40, 40, 3)))
    low, high = common_box(photos)
    assert bool(low.isfinite().all() and high.isfinite().all() and (high > low).all())
