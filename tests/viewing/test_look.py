"""What a painter shows is what the metrics see, and what it leaves out is left out."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import rasterizers
from clear_strategies.training.field import GaussianField
from clear_strategies.viewing.look import DepthScale, Painter
from tests.helpers import saved_run, toy, wall

CAMERA = toy.camera(0.2)


def make(**settings):
    return rasterizers.load("torch", **{"background": (0.2, 0.4, 0.6), **settings})


@pytest.fixture(scope="module")
def field(tmp_path_factory) -> GaussianField:
    return saved_run.write(tmp_path_factory.mktemp("run"))


def test_the_picture_is_the_one_that_is_measured(field):
    exact = field.render(make(), CAMERA).clamp(0, 1)
    assert torch.equal(Painter(field, make).color(CAMERA), exact)


def test_depth_is_the_distance_of_what_is_seen():
    """A wall at z = 4, over a background that must not count."""
    depth = Painter(wall.painter().field, make).depth(wall.at(0.0))
    torch.testing.assert_close(depth, torch.full((40, 60), 4.0), atol=0.02, rtol=0)


def test_depth_is_unknown_where_nothing_is(field):
    turned = replace(CAMERA, world_to_camera=torch.diag(torch.tensor([1.0, -1, -1, 1])) @ CAMERA.world_to_camera)
    depth = Painter(field, make).depth(turned)
    assert depth.isnan().all()
    picture = DepthScale.of(Painter(field, make), [turned]).picture(depth)
    assert (picture[0, 0] == 204).all()


def test_numbers_are_blended_over_black(field):
    painter = Painter(field, make)
    ones = painter.numbers(CAMERA, torch.ones(len(field)))
    assert float(ones.min()) >= 0
    assert float(ones.max()) <= 1 + 1e-6
    torch.testing.assert_close(painter.numbers(CAMERA, torch.full((len(field),), 0.5)), ones / 2)
