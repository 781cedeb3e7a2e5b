"""Points from depth maps: their spacing, what several photos see, and what fills the rest."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.dense_stereo.cloud import points_of
from clear_strategies.geometry.filling import grid_points
from tests.helpers.planes import photo


def flat(view: Photo, depth: float) -> DepthMap:
    shape = view.image.shape[:2]
    return DepthMap(torch.full(shape, depth), torch.ones(shape))


def unknown(view: Photo) -> DepthMap:
    shape = view.image.shape[:2]
    return DepthMap(torch.full(shape, torch.nan), torch.zeros(shape))


@pytest.mark.parametrize(("spacing", "count"), [(1.0, 1600), (2.0, 400), (1.6, 625)])
def test_there_is_one_point_per_square(spacing: float, count: int) -> None:
    view = photo()
    means, colors = points_of([view], [flat(view, 5.0)], spacing, 0.02)
    assert len(means) == len(colors) == count
    assert torch.allclose(means[:, 2], torch.tensor(5.0))


def test_what_two_photos_see_gets_its_points_once() -> None:
    views = [photo(), photo()]
    assert len(points_of(views, [flat(v, 5.0) for v in views], 2.0, 0.02)[0]) == 400
    apart = [flat(views[0], 5.0), flat(views[1], 6.0)]
    assert len(points_of(views, apart, 2.0, 0.02)[0]) == 800


def test_the_most_confident_pixel_of_a_square_is_taken() -> None:
    view = photo()
    result = flat(view, 5.0)
    result.confidence[:] = 0.5
    result.depth[1::2, 1::2] = 7.0
    result.confidence[1::2, 1::2] = 0.6
    assert (points_of([view], [result], 2.0, 0.02)[0][:, 2] == 7).all()


def test_only_unknown_pixels_are_filled_and_never_in_known_free_space() -> None:
    views = [photo(), photo(0.1)]
    samples = torch.cat((torch.rand(60, 2) - 0.5, torch.full((60, 1), 3.0)), dim=1)
    assert len(grid_points(samples, views, 2, maps=[flat(v, 5.0) for v in views])[0]) == 0
    assert len(grid_points(samples, views, 2, maps=[unknown(v) for v in views])[0]) == 800
    floating = grid_points(samples, views, 2, maps=[unknown(views[0]), flat(views[1], 5.0)])[0]
    assert len(floating) < 100
    close = grid_points(samples, views, 2, maps=[unknown(views[0]), flat(views[1], 3.1)])[0]
    assert len(close) == 400  # within 5 % of what the other photo knows
