"""Videos hold the frames that were written, and nothing is left of one that broke."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clear_strategies.errors import SettingError
from clear_strategies.viewing import video

ffmpeg = pytest.importorskip("imageio_ffmpeg")

FRAMES = [np.full((32, 48, 3), 20 * i, np.uint8) for i in range(10)]


def read(path):
    reader = ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])


def test_an_mp4_holds_the_frames_in_a_folder_that_looks_like_a_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    video.write_video(Path("10:30/a.mp4"), iter(FRAMES), fps=10)
    found = read(tmp_path / "10:30" / "a.mp4")
    assert found.shape == (10, 32, 48, 3)
    assert np.abs(found.mean((1, 2, 3)) - np.arange(10) * 20).max() < 4
    assert [path.name for path in Path("10:30").iterdir()] == ["a.mp4"]


def test_a_video_that_breaks_leaves_nothing(tmp_path):
    def broken():
        yield FRAMES[0]
        raise RuntimeError

    with pytest.raises(RuntimeError):
        video.write_video(tmp_path / "a.mp4", broken(), fps=10)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "frames", "message"), [("a.avi", FRAMES, "a video must be .mp4"), ("a.mp4", [], "needs at least 1 frame")]
)
def test_what_gives_no_video_is_refused(tmp_path, name, frames, message):
    with pytest.raises(SettingError, match=message):
        video.write_video(tmp_path / name, frames, fps=10)


def test_a_missing_program_and_a_missing_library_are_named(monkeypatch, tmp_path):
    def nowhere() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(ffmpeg, "get_ffmpeg_exe", nowhere)
    with pytest.raises(SettingError, match="does not run here: install ffmpeg"):
        video.write_video(tmp_path / "a.mp4", FRAMES, fps=10)
    monkeypatch.setattr(video, "find_spec", lambda _: None)
    with pytest.raises(SettingError, match="pip install imageio-ffmpeg"):
        video.write_video(tmp_path / "a.mp4", FRAMES, fps=10)
