"""Of a video, the sharp frames along the camera's path become photos; blurred and repeated ones do not."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data

from clear_strategies.data.capture import Capture
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.readers import photos, video
from clear_strategies.data.readers.video import choose, frames_of
from clear_strategies.errors import DataError, SettingError
from clear_strategies.viewing.video import write_video

SIZE = (180, 320)
BLURRED, STILL = range(20, 24), range(40, 48)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A camera that pans 4 px a frame, shakes for four frames and stands still for eight."""
    picture = cv2.resize(skimage.data.astronaut(), (800, 800))
    at, frames = 0, []
    for i in range(80):
        at += 0 if i in STILL else 4
        frame = picture[200 : 200 + SIZE[0], at : at + SIZE[1]]
        frames.append(cv2.GaussianBlur(frame, (0, 0), 4) if i in BLURRED else frame)
    path = tmp_path_factory.mktemp("clip") / "around the room.mp4"
    write_video(path, frames, fps=30)
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def test_the_chosen_frames_are_sharp_and_lie_evenly_along_the_path(clip):
    sharpness, movement = video._scores(clip)
    assert len(sharpness) == 80
    assert movement[1:20] == pytest.approx(4 / 320, abs=1e-3)
    frames, summary = choose(sharpness, movement, 12)
    assert re.fullmatch(r"12 of 80 frames \(4 blurred, [78] without movement\)", summary)
    assert len(frames) == 12
    assert not set(frames) & set(BLURRED)
    steps = np.diff(np.cumsum(movement)[frames])
    part = movement.sum() / 12
    assert (steps > 0).all()
    assert steps.max() <= 2 * part


def test_the_frames_are_files_that_are_made_once(clip):
    folder = frames_of(clip, 5)
    files = sorted(folder.glob("*.jpg"))
    assert [file.name for file in files] == [f"around the room_{k:03d}.jpg" for k in range(1, 6)]
    assert cv2.imread(str(files[0])).shape == (*SIZE, 3)
    assert re.match(r"5 of 80 frames \(4 blurred, \d without movement\)", (folder / video.CHOICE).read_text())
    before = files[0].stat().st_mtime_ns
    assert frames_of(clip, 5) == folder
    assert files[0].stat().st_mtime_ns == before


def test_photos_have_the_colours_of_a_phones_video(tmp_path):
    wall = np.random.default_rng(0).integers(0, 40, (24, 80, 1)).repeat(4, 0).repeat(4, 1) + np.array((10, 160, 10))
    frames = [wall[:, 4 * i : 4 * i + 160].astype(np.uint8) for i in range(40)]
    write_video(tmp_path / "clip.mp4", frames, fps=30)  # BT.709, as phones write
    photo = read_image(next(frames_of(tmp_path / "clip.mp4", 5).glob("*.jpg")))
    assert photo.mean((0, 1)).mul(255).tolist() == pytest.approx((30, 180, 30), abs=5)


def test_a_video_may_be_named_by_the_time_of_its_making(clip, tmp_path, monkeypatch):
    shutil.copy(clip, tmp_path / "2026-11-26T10:30:00.mp4")
    monkeypatch.chdir(tmp_path)
    assert len([*frames_of(Path("2026-11-26T10:30:00.mp4"), 3).glob("*.jpg")]) == 3


def test_hundreds_of_frames_can_be_chosen(tmp_path, monkeypatch):
    long = tmp_path / "long.mp4"
    write_video(long, (np.full((32, 32, 3), i, np.uint8) for i in range(250)), fps=30)
    monkeypatch.setattr(video, "_scores", lambda _: (np.ones(250), np.ones(250)))
    files = sorted(frames_of(long, 240).glob("*.jpg"))
    assert len(files) == 240
    assert cv2.imread(str(files[-1])).mean() == pytest.approx(249, abs=4)


def test_a_choice_that_ffmpeg_did_not_write_whole_is_refused_and_not_kept(clip, monkeypatch):
    monkeypatch.setattr(video, "_scores", lambda _: (np.ones(120), np.ones(120)))  # the clip has 80 frames
    for _ in range(2):
        with pytest.raises(DataError, match="gives 6 of the 8 chosen frames"):
            frames_of(clip, 8)


def test_the_number_of_frames_follows_the_path():
    steady = np.ones(1000)
    for movement, count in ((0.003, 25), (0.03, 40), (0.0003, 12)):  # of the width for each frame
        assert len(choose(steady, np.full(1000, movement), None)[0]) == count


def test_photos_of_a_video_are_its_frames_and_the_scene_has_its_name(clip, monkeypatch):
    seen = []
    monkeypatch.setattr(photos.sfm, "reconstruct", lambda root, found, *_: seen.extend(found))
    monkeypatch.setattr(photos.sfm, "require_placed", lambda *_: None)
    monkeypatch.setattr(photos, "_capture", lambda root, *_: Capture(root.name, (), None))
    assert photos.read(clip, frames=6).name == clip.name
    assert [path.name for path in seen] == [f"around the room_{k:03d}.jpg" for k in range(1, 7)]


def test_frames_are_of_a_video(tmp_path):
    with pytest.raises(SettingError, match=r"data\.reader\.frames: .* is no video"):
        photos.read(tmp_path, frames=5)
    with pytest.raises(SettingError, match=r"data\.reader\.frames: must be"):
        photos.read(tmp_path, frames=2)
