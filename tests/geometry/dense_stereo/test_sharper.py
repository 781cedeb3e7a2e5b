"""Depth of LR photos by way of sharper ones: on the LR grid, more exact, unknown where a block is mostly unknown."""

from __future__ import annotations

import torch

from clear_strategies.core import images
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.dense_stereo.sharper import depth_maps_from_sharper, reduced
from tests.geometry.dense_stereo.test_maps import NONE, photos_of
from tests.helpers.textured import camera, cast, slanted


def test_a_block_has_the_median_of_what_it_knows_and_nothing_where_it_knows_little() -> None:
    nan = torch.nan
    depth = torch.tensor([[1.0, 2.0, nan, nan], [3.0, nan, nan, 7.0], [9.0, 9.0, 9.0, 9.0]])
    confidence = torch.where(depth.isnan(), 0.0, 0.5)
    small = reduced(DepthMap(depth, confidence), 2)
    assert small.depth[0, 0] == 2.0
    assert small.confidence[0, 0] == 0.5
    assert small.depth[0, 1].isnan()
    assert small.confidence[0, 1] == 0
    assert small.depth.shape == (1, 2)


def test_the_depth_lies_on_the_grid_of_the_lr_photos_and_is_closer_to_the_surface() -> None:
    sharper = photos_of(slanted, size=(160, 120))
    photos = [Photo(s.camera.scaled(1 / 4), images.downsample(s.image, 4)) for s in sharper]
    settings = StereoSettings(enlarge=1, max_planes=64)
    errors = []
    for found in (depth_maps(photos, NONE, settings), depth_maps_from_sharper(photos, sharper, NONE, settings)):
        middle = found[1]
        exact = cast(slanted, camera(0.0, 0, (40, 30)))[1]
        assert middle.depth.shape == (30, 40)
        assert middle.coverage > 0.3
        errors.append(float((middle.depth / exact - 1).abs()[middle.known].median()))
    assert errors[1] < 0.8 * errors[0]
