"""The demo room: exact, anti-aliased, deterministic, with features at LR scale."""

from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.capture import Capture
from clear_strategies.data.readers import demo
from clear_strategies.data.readers.demo_surfaces import Rays, Texture
from clear_strategies.errors import SettingError
from clear_strategies.geometry.projection import back_project, project, sample_colors, seen_pixels
from rasterizers.interface import Camera

WIDTH, HEIGHT, FACTOR = 128, 96, 4


@cache
def capture() -> Capture:
    return demo.read(width=WIDTH, height=HEIGHT)


def depth_of(camera: Camera) -> Tensor:
    """Depth (z) through each pixel's centre: the ground truth."""
    rays = Rays.through(camera, 0, camera.height, 1)
    return torch.from_numpy(np.min([surface.depth(rays) for surface in demo.room()], axis=0))


def test_photos_fill_the_picture_and_cameras_look_at_the_room_upright_from_different_places() -> None:
    assert [i for i, frame in enumerate(capture().frames) if frame.split == "train"] == [2, 6, 10]
    for frame in capture().frames[::5]:
        photo = frame.load().image
        assert photo.shape == (HEIGHT, WIDTH, 3)
        assert photo.dtype == torch.float32
        assert torch.equal(photo, images.quantize(photo))
        assert depth_of(frame.camera).isfinite().all()
        assert 0.3 < photo.mean() < 0.6
        assert (photo == 1).float().mean() < 0.02
    centers = []
    for frame in capture().frames:
        rotation = frame.camera.world_to_camera[:3, :3]
        assert torch.allclose(rotation @ rotation.T, torch.eye(3).double(), atol=1e-12)
        assert torch.det(rotation) == pytest.approx(1)
        assert abs(float(rotation[0, 1])) < 1e-12  # the x axis is level
        assert float(rotation[1, 1]) > 0.95  # and y points down
        centers.append(frame.camera.center)
    assert float((centers[0] - centers[-1]).norm()) == pytest.approx(1.5)


def test_as_many_views_train_as_were_asked_for_and_impossible_splits_are_refused() -> None:
    for views, train in ((3, 2), (16, 7), (8, 7), (11, 2)):
        frames = demo.read(width=8, height=8, views=views, train=train).frames
        assert sum(frame.split == "train" for frame in frames) == train
        assert len({frame.name for frame in frames}) == views
    for views, train in ((3, 3), (12, 1), (2, 4)):
        with pytest.raises(SettingError, match=r"data\.reader\.train: 2 <= train < views must hold"):
            demo.read(views=views, train=train)


def test_neighbouring_views_agree_where_depth_says_they_see_the_same_place() -> None:
    """What view 5 sees by its depth has the same colour in view 6 where nothing hides it there."""
    a, b = (frame.load() for frame in capture().frames[5:7])
    pixels = torch.cartesian_prod(torch.arange(WIDTH), torch.arange(HEIGHT)).double() + 0.5
    column, row = pixels.long().T
    inside, v, u, z = seen_pixels(
        b.camera, points := back_project(a.camera, pixels, depth_of(a.camera)[row, column].double())
    )
    seen = inside.nonzero()[:, 0][(depth_of(b.camera)[v, u] - z).abs() < 0.05]
    shown = a.image[row[seen], column[seen]]
    same = (sample_colors(b, project(b.camera, points[seen])[0]) - shown).abs().mean(-1)
    other = (b.image[row[seen], column[seen]] - shown).abs().mean(-1)
    assert len(seen) > 0.7 * len(points)
    assert same.mean() < 0.05
    assert same.mean() < 0.6 * other.mean()


def test_photos_are_free_of_aliasing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Near the limit of many rays without prefiltering; one ray a pixel, which does alias, is five times further away."""
    camera = demo.read(width=64, height=48).frames[5].camera
    photo = demo.render(camera)
    sample = Texture.sample
    monkeypatch.setattr(Texture, "sample", lambda self, at, footprint: sample(self, at, np.ones_like(footprint)))
    monkeypatch.setattr(demo, "_RAYS", 16)
    limit = demo.render(camera)
    monkeypatch.setattr(demo, "_RAYS", 1)
    aliased = demo.render(camera)

    def rms(image: Tensor) -> float:
        return float((image - limit).square().mean().sqrt())

    assert rms(photo) < 3 / 255
    assert rms(aliased) > 5 * rms(photo)
