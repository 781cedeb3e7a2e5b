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
    """Back-project view 5 by its depth into view 6: what is not hidden there has the same colour."""
    a, b = capture().frames[5], capture().frames[6]
    depth = depth_of(a.camera).double()
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    local = torch.stack(((x - a.camera.cx) / a.camera.fx, (y - a.camera.cy) / a.camera.fy, torch.ones_like(x)), -1)
    world = (local * depth[..., None] - a.camera.world_to_camera[:3, 3]) @ a.camera.world_to_camera[:3, :3]
    there = world @ b.camera.world_to_camera[:3, :3].T + b.camera.world_to_camera[:3, 3]
    u = there[..., 0] / there[..., 2] * b.camera.fx + b.camera.cx
    v = there[..., 1] / there[..., 2] * b.camera.fy + b.camera.cy
    grid = torch.stack((2 * u / WIDTH - 1, 2 * v / HEIGHT - 1), -1)[None].float()

    def at(values: Tensor) -> Tensor:
        return torch.nn.functional.grid_sample(values[None], grid, align_corners=False)[0]

    seen = (at(depth_of(b.camera).float()[None])[0] - there[..., 2]).abs() < 0.02
    same = (at(b.load().image.permute(2, 0, 1)).permute(1, 2, 0) - a.load().image).abs().mean(-1)[seen]
    other = (b.load().image - a.load().image).abs().mean(-1)[seen]
    assert seen.float().mean() > 0.7
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
