"""Camera paths are closed, even, and pass what they must."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from clear_strategies.errors import SettingError
from clear_strategies.viewing import paths
from rasterizers.interface import Camera
from tests.helpers import toy


def at(center: tuple[float, float, float], focus: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    """A camera that looks at the focus, with y pointing down in the world."""
    forward = np.subtract(focus, center) / np.linalg.norm(np.subtract(focus, center))
    right = np.cross(forward, [0, -1, 0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.array(center, float)
    return Camera(torch.from_numpy(pose), 100.0, 100.0, 48.0, 32.0, 96, 64)


RING = [at((3 * math.cos(a), 0.2 * math.sin(3 * a), 3 * math.sin(a))) for a in np.arange(12) * math.tau / 12]
SHUFFLED = [RING[i] for i in (0, 5, 10, 3, 8, 1, 6, 11, 4, 9, 2, 7)]


def centers(cameras: list[Camera]) -> np.ndarray:
    return np.stack([camera.center.numpy() for camera in cameras])


def test_a_path_passes_its_cameras_and_is_even_and_closed_and_looks_where_they_look():
    frames = paths.through(SHUFFLED, 120)
    path = centers(frames)
    for camera in RING:
        assert np.linalg.norm(path - camera.center.numpy(), axis=1).min() < 0.1
    steps = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
    assert steps.max() < 1.3 * steps.min()  # the last step leads to the first frame
    for camera in frames:
        forward, inwards = camera.world_to_camera[2, :3], -camera.center / camera.center.norm()
        assert float(forward @ inwards) > 0.99
        R = camera.world_to_camera[:3, :3]
        torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=R.dtype))


def test_many_cameras_are_thinned():
    dense = [at((3 * math.cos(a), 0.0, 3 * math.sin(a))) for a in np.arange(100) * math.tau / 100]
    steps = np.linalg.norm(np.diff(centers(paths.through(dense, 60)), axis=0), axis=1)
    assert steps.max() < 1.5 * steps.min()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_cameras_and_cameras_at_one_place_give_a_path_too(count):
    path = paths.through(RING[:count], 10)
    assert len(path) == 10
    assert len({tuple(center.round(6)) for center in centers(path)}) > 3
    assert np.isfinite(centers(path)).all()
    still = paths.through([RING[0]] * (count + 1), 5)  # several cameras at one place
    np.testing.assert_allclose(centers(still), np.tile(RING[0].center.numpy(), (5, 1)), atol=1e-6)


def test_the_point_that_cameras_look_at():
    np.testing.assert_allclose(paths.look_at(RING), 0, atol=1e-9)
    parallel = [toy.camera(0.0), toy.camera(0.0)]
    assert np.isfinite(paths.look_at(parallel)).all()


@pytest.mark.parametrize(("cameras", "frames"), [([], 5), (RING, 0)])
def test_what_gives_no_path_is_refused(cameras, frames):
    with pytest.raises(SettingError, match="needs at least"):
        paths.through(cameras, frames)
