"""`clear-strategies render RUN`: which files it leaves."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from clear_strategies.commands import render
from clear_strategies.data.photo_files import image_size, read_image
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from tests.helpers import saved_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, saved_run.write(folder)


def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_a_loop_is_a_video_and_on_request_pictures_and_depth(run, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    folder, _ = run
    render.main([str(folder), "--frames", "3", "--depth", "--images", "--out", str(tmp_path)])
    frames = [f"{i:04d}.png" for i in range(3)]
    videos = ["cameras.mp4", "cameras_depth.mp4"]
    assert files(tmp_path) == sorted([*frames, *(f"depth/{name}" for name in frames), *videos])
    assert image_size(tmp_path / "0000.png") == (96, 64)
    assert image_size(tmp_path / "depth" / "0000.png") == (96, 64)


def test_test_views_are_what_was_evaluated(run, tmp_path):
    folder, field = run
    render.main([str(folder), "--path", "test", "--out", str(tmp_path)])
    (view,) = saved_run.SCENE.test
    assert files(tmp_path) == [f"{view.name}.png"]
    import rasterizers

    exact = field.render(rasterizers.load("torch"), view.hr.camera).clamp(0, 1)
    torch.testing.assert_close(read_image(tmp_path / f"{view.name}.png"), exact, atol=0.5 / 255 + 1e-5, rtol=0)


def test_the_default_folder_lies_in_the_run_and_width_sets_the_size(run):
    folder, _ = run
    render.main([str(folder), "--path", "train", "--width", "48"])
    assert image_size(folder / "rendered" / "view0.png") == (48, 32)


def test_a_file_of_cameras_is_a_path(run, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    folder, _ = run
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[2, 3] = -4
    entry = {"camera_to_world": matrix.flatten().tolist(), "fov": 40, "aspect": 1.5}
    content = {"render_width": 60, "render_height": 40, "fps": 12, "camera_path": [entry] * 4}
    (tmp_path / "flight.json").write_text(json.dumps(content))
    render.main([str(folder), "--path", str(tmp_path / "flight.json"), "--out", str(tmp_path)])
    assert files(tmp_path) == ["flight.json", "flight.mp4"]


def test_frames_of_portrait_and_landscape_cameras_are_not_stretched(run, tmp_path):
    folder, _ = run
    (entry, *_) = json.loads((folder / "cameras.json").read_text())
    sizes = {"width": 60, "height": 40, "cx": 33, "cy": 20}, {"width": 40, "height": 60, "cx": 20, "cy": 33}
    (tmp_path / "path.json").write_text(json.dumps([{**entry, **size, "fx": 50, "fy": 50} for size in sizes]))
    options = render._parser().parse_args([str(folder), "--path", str(tmp_path / "path.json")])
    _, (landscape, portrait), _ = render.cameras_of(open_splat(folder), options)
    assert (landscape.width, landscape.height) == (portrait.width, portrait.height) == (60, 40)
    assert portrait.fx == portrait.fy == pytest.approx(50 * 40 / 60)  # its whole height, and more at both sides
    assert (portrait.cx, portrait.cy) == pytest.approx((30, 22))


def test_parts_of_a_ply_that_cannot_be_left_out_are_named(run, tmp_path, caplog):
    folder, _ = run
    render.main([str(folder / "point_cloud.ply"), "--path", "test", "--no-detail", "--out", str(tmp_path)])
    assert "--no-detail and --no-filter have no effect" in caplog.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--path", "nowhere"], "--path: must be cameras, train, test or a file"),
        (["--frames", "0"], "must be above 0"),
        (["--fps", "nan"], "must be above 0"),
        (["--typo"], "unrecognized arguments: --typo"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(run, arguments, message):
    with pytest.raises(SettingError, match=message):
        render.main([str(run[0]), *arguments])
