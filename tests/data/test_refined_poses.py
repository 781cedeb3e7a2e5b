"""Poses that are refined by bundle adjustment, on the demo's room, whose cameras are known."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from clear_strategies.core.view import Photo
from clear_strategies.data import refined_poses
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.readers import demo
from clear_strategies.data.readers.features import SfmSettings
from clear_strategies.data.refined_poses import refined
from clear_strategies.jobs import scene
from rasterizers.interface import Camera

pytest.importorskip("pycolmap")

SETTINGS = SfmSettings(threads=1)


def seen_by(frame: Frame, camera: Camera) -> Frame:
    return replace(frame, camera=camera, load=lambda: replace(frame.load(), camera=camera))


@pytest.fixture(scope="module")
def truth() -> Capture:
    capture = demo.read(width=200, height=150)
    return replace(capture, frames=capture.frames[:4])


@pytest.fixture(scope="module")
def given(truth: Capture) -> Capture:
    """The cameras turned by up to three degrees, moved by a tenth of their distances, and of focal lengths 5 to 8 % too large."""
    random, frames = np.random.default_rng(0), []
    for frame in truth.frames:
        pose = frame.camera.world_to_camera.double().numpy().copy()
        pose[:3, :3] = Rotation.from_rotvec(np.radians(random.uniform(-2, 2, 3))).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += random.normal(size=3) * 0.02
        longer = 1.05 + 0.01 * len(frames)  # networks estimate it for each photo
        camera = replace(
            frame.camera,
            world_to_camera=torch.from_numpy(pose),
            fx=longer * frame.camera.fx,
            fy=1.02 * longer * frame.camera.fy,
            cx=frame.camera.cx + (-1) ** len(frames),
        )
        frames.append(seen_by(frame, camera))
    return replace(truth, frames=tuple(frames))


def errors(capture: Capture, truth: Capture) -> tuple[float, float]:
    """The largest angle between the cameras' relative rotations and the true ones, degrees, and the error of the focal length."""

    def turns(of: Capture) -> Rotation:
        rotations = [Rotation.from_matrix(frame.camera.world_to_camera[:3, :3].numpy()) for frame in of.frames]
        return Rotation.concatenate([rotation * rotations[0].inv() for rotation in rotations[1:]])

    angles = np.degrees((turns(capture) * turns(truth).inv()).magnitude())
    return float(angles.max()), abs(capture.frames[0].camera.fx / truth.frames[0].camera.fx - 1)


def test_inexact_poses_become_those_of_the_photos_in_the_given_world(
    given: Capture, truth: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = refined(given, tmp_path, SETTINGS)
    before, after = errors(given, truth), errors(capture, truth)
    assert before[0] > 1.5
    assert after[0] < 0.25
    assert after[1] < 0.02 < before[1]
    lenses = [(c.fx, c.fy, c.cx, c.cy) for c in (frame.camera for frame in capture.frames)]
    assert lenses == [(lenses[0][0], lenses[0][0], 100.0, 75.0)] * 4  # one lens, square pixels
    for frame, start, true in zip(capture.frames, given.frames, truth.frames, strict=True):
        assert frame.load().camera is frame.camera
        assert torch.equal(frame.load().image, true.load().image)
        moved = frame.camera.world_to_camera - start.camera.world_to_camera  # in the same world, in the same units
        assert moved.abs().max() < 0.25
    # Points lie where their rays meet: in front of the cameras that see them, inside of the photos.
    assert capture.points is not None
    ids = {frame.sfm_id: frame.camera for frame in capture.frames}
    assert len(capture.points.means) > 100
    for point, image in zip(capture.points.track_point.tolist(), capture.points.track_image.tolist(), strict=True):
        pose = ids[image].world_to_camera
        x, y, z = (pose[:3, :3] @ capture.points.means[point].to(pose) + pose[:3, 3]).tolist()
        assert z > 0
        assert -2 < ids[image].fx * x / z + ids[image].cx < 202
        assert -2 < ids[image].fy * y / z + ids[image].cy < 152
    assert re.search(r"4 of 4 refined by pycolmap, by 1\.\d\d degrees \(median\)$", capture.notes["poses"])

    monkeypatch.setattr(refined_poses, "_adjusted", None)  # the cache holds them
    again = refined(given, tmp_path, SETTINGS)
    for one, other in zip(capture.frames, again.frames, strict=True):
        assert torch.equal(one.camera.world_to_camera, other.camera.world_to_camera)


def flat(frame: Frame) -> Frame:
    def load() -> Photo:
        photo = frame.load()
        return replace(photo, image=torch.full_like(photo.image, 0.5))

    return replace(frame, load=load)


@pytest.mark.parametrize(
    ("shown", "told"),
    [(3, "1 of 4 photos share too little with the others, and keep their poses: "), (0, "no effect: no two photos")],
)
def test_photos_that_share_nothing_keep_their_poses(
    given: Capture, tmp_path: Path, caplog: pytest.LogCaptureFixture, shown: int, told: str
) -> None:
    some_flat = replace(given, frames=(*given.frames[:shown], *map(flat, given.frames[shown:])))
    capture = refined(some_flat, tmp_path, SETTINGS)
    assert told in caplog.text
    for i, (frame, start) in enumerate(zip(capture.frames, some_flat.frames, strict=True)):
        assert torch.equal(frame.camera.world_to_camera, start.camera.world_to_camera) == (i >= shown)
    assert list(tmp_path.glob("*.*")) == []


@pytest.mark.parametrize("refine", [True, False])
def test_a_job_refines_poses_if_its_data_ask_for_it(
    truth: Capture, refine: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    other: Callable[[Capture], Capture] = lambda capture: replace(capture, name="refined")  # noqa: E731
    monkeypatch.setattr(scene, "refined", other)
    capture, _ = scene.read(scene.DataSettings(reader=lambda: truth, refine_poses=refine), None)
    assert capture.name == ("refined" if refine else truth.name)
