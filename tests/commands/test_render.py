"""`clear-strategies render RUN`: which files it leaves."""

from __future__ import annotations

import json

import pytest
import torch

import rasterizers
from clear_strategies.commands import render
from clear_strategies.data.photo_files import image_size, read_image
from clear_strategies.errors import SettingError
from tests.helpers import toy


def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_a_loop_is_a_video_and_on_request_one_of_the_depth(saved_run, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    render.main([str(saved_run[0]), "--frames", "3", "--depth", "--out", str(tmp_path)])
    assert files(tmp_path) == ["cameras.mp4", "cameras_depth.mp4"]


def test_test_views_are_what_was_evaluated(saved_run, tmp_path):
    folder, field = saved_run
    render.main([str(folder), "--path", "test", "--out", str(tmp_path)])
    (view,) = toy.scene().test
    assert files(tmp_path) == [f"{view.name}.png"]
    exact = field.render(rasterizers.load("torch"), view.hr.camera).clamp(0, 1)
    torch.testing.assert_close(read_image(tmp_path / f"{view.name}.png"), exact, atol=0.5 / 255 + 1e-5, rtol=0)


def test_the_default_folder_lies_in_the_run_and_width_sets_the_size(saved_run):
    folder, _ = saved_run
    render.main([str(folder), "--path", "train", "--width", "48"])
    assert image_size(folder / "rendered" / "view0.png") == (48, 32)


def test_a_file_of_cameras_gives_a_picture_of_each_and_of_its_depth(saved_run, tmp_path):
    folder, _ = saved_run
    (entry, *_) = json.loads((folder / "cameras.json").read_text())
    (tmp_path / "path.json").write_text(json.dumps([{**entry, "img_name": name} for name in "ab"]))
    render.main([str(folder), "--path", str(tmp_path / "path.json"), "--depth", "--out", str(tmp_path / "out")])
    assert files(tmp_path / "out") == ["a.png", "b.png", "depth/a.png", "depth/b.png"]
    assert image_size(tmp_path / "out" / "depth" / "b.png") == (96, 64)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--path", "nowhere"], "--path: must be cameras, train, test or a file"),
        (["--frames", "0"], "must be above 0"),
        (["--width", "0"], "must be above 0"),
        (["--typo"], "unrecognized arguments: --typo"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(saved_run, arguments, message):
    with pytest.raises(SettingError, match=message):
        render.main([str(saved_run[0]), *arguments])
