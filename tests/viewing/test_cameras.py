"""Cameras as files, closed, even paths along them, and videos."""

import errno
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg as ffmpeg
import numpy as np
import pytest
import torch

from clear_strategies.errors import DataError, SettingError
from clear_strategies.viewing import cameras, look
from rasterizers.interface import Camera
from tests.helpers import toy
from tests.helpers.full_disk import full_disk

# ---- cameras as files: what a run writes is what is read
SCENE = toy.scene(train=3, test=1)


def same(a, b):
    torch.testing.assert_close(a.world_to_camera.double(), b.world_to_camera.double(), atol=1e-6, rtol=0)
    assert (a.fx, a.fy, a.cx, a.cy, a.width, a.height) == pytest.approx((b.fx, b.fy, b.cx, b.cy, b.width, b.height))


def test_what_a_run_writes_and_what_inria_writes_is_read(tmp_path):
    cameras.write_cameras(tmp_path, SCENE)
    found = cameras.read_cameras(tmp_path / cameras.FILE)
    assert [saved.name for saved in found] == [view.name for view in (*SCENE.train, *SCENE.test)]
    assert [saved.split for saved in found] == ["train"] * 3 + ["test"]
    for saved, view in zip(found, (*SCENE.train, *SCENE.test), strict=True):
        same(saved.camera, view.hr.camera)
    entry = {
        "id": 0, "img_name": "a", "width": 40, "height": 20, "position": [0, 0, -4], "rotation": np.eye(3).tolist(),
        "fx": 50, "fy": 50,
    }  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    (found,) = cameras.read_cameras(tmp_path / "cameras.json")
    assert (found.camera.cx, found.camera.cy) == (20, 10)
    assert found.camera.center.tolist() == [0, 0, -4]


TURNED = [{"width": 4, "height": 4, "fx": 4, "fy": 4, "rotation": [[1, 0], [0, 1]], "position": [0, 0, 0]}]
NAMED = [{**TURNED[0], "rotation": np.eye(3).tolist(), "img_name": "a\0"}]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is not there"), ("", "is not valid"), ("[{", "is not valid"), ("[]", "is an empty list"),
        ("[1]", "must be"), ("[{}]", "is missing"), ("{}", "must be `array`"),
        (json.dumps(TURNED), r"\[0\]\.rotation: must be `array` of length 3"),
        (json.dumps(NAMED), r"\[0\]: a\\x00: name: must be UTF-8 without control characters"),
    ],
)  # fmt: skip
def test_what_holds_no_cameras_is_refused_in_one_line(tmp_path, content, message):
    if content is not None:
        (tmp_path / "path.json").write_text(content)
    with pytest.raises(DataError, match=rf"path\.json: .*{message}"):
        cameras.read_cameras(tmp_path / "path.json")


@pytest.mark.parametrize(("longest", "size"), [(None, (96, 64)), (48, (48, 32)), (31, (32, 20)), (1000, (96, 64))])
def test_videos_have_even_sizes(longest, size):
    camera = cameras.at_most(toy.camera(0.1), longest)
    assert (camera.width, camera.height) == size
    assert camera.fx / camera.width == pytest.approx(1.1)


# ---- camera paths are closed, even, and pass what they must
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
    frames = cameras.through(SHUFFLED, 120)
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


def test_a_path_along_an_arc_comes_back_along_it_and_not_through_the_scene():
    arc = [at((3 * math.cos(a), 0.0, 3 * math.sin(a))) for a in np.linspace(0, math.pi, 12)]
    path = centers(cameras.through([*arc[5:], *arc[:5]], 60))
    np.testing.assert_allclose(np.linalg.norm(path, axis=1), 3, atol=0.05)
    for end in (arc[0], arc[-1]):
        assert np.linalg.norm(path - end.center.numpy(), axis=1).min() < 0.1
    steps = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
    assert steps.max() < 0.6


@pytest.mark.parametrize("upside_down", [[0], range(1, 12, 2), range(4, 12)])
def test_a_path_past_photos_that_were_taken_upside_down_does_not_roll_and_the_viewer_stands_upright(upside_down):
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    ring = [replace(c, world_to_camera=turn @ c.world_to_camera) if i in upside_down else c for i, c in enumerate(RING)]
    down = np.stack([frame.world_to_camera[1, :3].numpy() for frame in cameras.through(ring, 60)])
    assert np.abs(down[:, 1]).min() > 0.99
    assert (down[:, 1] > 0).all() == (len(upside_down) < 7)  # as most photos are
    sign = 1 if len(upside_down) < 7 else -1
    np.testing.assert_allclose(cameras.up(ring), (0, -sign, 0), atol=0.02)  # the viewer's


def test_many_cameras_are_thinned():
    dense = [at((3 * math.cos(a), 0.0, 3 * math.sin(a))) for a in np.arange(100) * math.tau / 100]
    steps = np.linalg.norm(np.diff(centers(cameras.through(dense, 60)), axis=0), axis=1)
    assert steps.max() < 1.5 * steps.min()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_cameras_and_cameras_at_one_place_give_a_path_too(count):
    path = cameras.through(RING[:count], 10)
    assert len(path) == 10
    assert len({tuple(center.round(6)) for center in centers(path)}) > 3
    assert np.isfinite(centers(path)).all()
    still = cameras.through([RING[0]] * (count + 1), 5)  # several cameras at one place
    np.testing.assert_allclose(centers(still), np.tile(RING[0].center.numpy(), (5, 1)), atol=1e-6)


# ---- videos hold the frames that were written, and nothing is left of one that broke
FRAMES = [np.full((32, 48, 3), 20 * i, np.uint8) for i in range(10)]


def frames_of(path):
    reader = ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])


def test_an_mp4_holds_the_frames_in_a_folder_that_looks_like_a_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    look.write_video(Path("10:30/a.mp4"), iter(FRAMES))
    found = frames_of(tmp_path / "10:30" / "a.mp4")
    assert found.shape == (10, 32, 48, 3)
    assert np.abs(found.mean((1, 2, 3)) - np.arange(10) * 20).max() < 4
    assert [path.name for path in Path("10:30").iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_video_that_breaks_leaves_no_file_and_no_process(error, tmp_path, monkeypatch):
    def broken():
        yield FRAMES[0]
        raise error

    started, start = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(start(*a, **k)) or started[-1])
    with pytest.raises(error):
        look.write_video(tmp_path / "a.mp4", broken())
    assert not list(tmp_path.iterdir())
    assert started[-1].poll() is not None


@pytest.mark.parametrize("side", [32, 256], ids=["at the end", "while frames are written"])
def test_a_video_for_which_the_disk_is_too_full_is_told_and_leaves_nothing(side, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (side, side, 3)).astype(np.uint8)
    with full_disk(), pytest.raises(OSError, match=r"ffmpeg could write 0 of 60 frames: .*a\.mp4") as refused:
        look.write_video(tmp_path / "a.mp4", [noise] * 60)
    assert refused.value.errno == errno.EIO
    assert not list(tmp_path.iterdir())


def test_a_missing_program_and_a_missing_library_are_named(monkeypatch, tmp_path):
    def nowhere() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(ffmpeg, "get_ffmpeg_exe", nowhere)
    with pytest.raises(SettingError, match="does not run here: install ffmpeg"):
        look.write_video(tmp_path / "a.mp4", FRAMES)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(SettingError, match="pip install imageio-ffmpeg"):
        look.write_video(tmp_path / "a.mp4", FRAMES)
