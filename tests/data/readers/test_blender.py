"""NeRF-synthetic: OpenGL poses, RGBA over white, the order and the numbers of the protocol."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from PIL import Image

from clear_strategies.data.readers import blender
from tests.helpers import captures as tiny

PROTOCOL = {2, 16, 26, 55, 73, 76, 86, 93}


def test_splits_are_those_of_the_files(tmp_path: Path) -> None:
    capture = blender.read(tiny.blender(tmp_path))
    assert [(f.name, f.split) for f in capture.frames] == [("a", "train"), ("b", "train"), ("test/c", "test")]
    assert capture.background == (1.0, 1.0, 1.0)


def test_the_order_is_that_of_the_file_and_endings_may_be_given(tmp_path: Path) -> None:
    tiny.blender(tmp_path)
    for i, name in enumerate(("r_2", "r_10")):
        (tmp_path / "train" / tiny.NAMES[i]).rename(tmp_path / f"train/{name}.png")
    frames = [{"file_path": f"train/{name}.png", "transform_matrix": tiny.opengl(0)} for name in ("r_2", "r_10")]
    tiny.write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 0.7, "frames": frames})
    assert [frame.name for frame in blender.read(tmp_path).frames] == ["r_2", "r_10", "test/c"]


def test_the_lens_and_the_masks_that_a_file_names_are_used(tmp_path: Path) -> None:
    tiny.blender(tmp_path)
    Image.new("L", (tiny.WIDTH, tiny.HEIGHT)).save(tmp_path / "m.png")
    real = {"camera_angle_x": 0.9, "w": 32, "h": 24, "fl_x": 44.0, "fl_y": 46.0, "cx": 15.0, "cy": 13.0}
    frames = [{"file_path": "train/a", "transform_matrix": tiny.opengl(0), "mask_path": "m.png"}]
    for name, lens in (("transforms_train.json", {}), ("transforms_test.json", {"k1": -0.1})):
        tiny.write_json(tmp_path / name, {**real, **lens, "frames": frames})
    capture = blender.read(tmp_path)
    train, test = capture.frames
    assert (train.camera.fx, train.camera.fy, train.camera.cx, train.camera.cy) == (22, 23, 7.5, 6.5)
    assert not train.shown().any()
    assert "1 of 2 photos undistorted" in capture.notes["lens"]
    assert not torch.equal(test.load(), train.load())


def test_a_scene_without_test_views_is_read_and_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tiny.blender(tmp_path) / "transforms_test.json").unlink()
    assert [frame.split for frame in blender.read(tmp_path).frames] == ["train", "train"]
    assert "no test views" in caplog.text


def test_the_protocols_frames_of_lego_are_found_by_number(shared_data: Path) -> None:
    capture = blender.read(shared_data / "lego")
    train = {int(frame.name.removeprefix("r_")): frame for frame in capture.frames if frame.split == "train"}
    assert set(train) >= PROTOCOL
    assert len(train) == 25
    assert [f.name for f in capture.frames if f.split == "test"] == [f"test/r_{i}" for i in range(0, 200, 8)]
    for number in sorted(PROTOCOL):
        camera = train[number].camera
        assert camera.center.norm() == pytest.approx(4.031, abs=1e-3)  # on NeRF's sphere around the scene
        forward = camera.world_to_camera[2, :3]
        assert (-camera.center / camera.center.norm()) @ forward == pytest.approx(1, abs=1e-5)  # looking at its middle
    assert train[2].camera.fx == pytest.approx(1111.111, abs=1e-3)
    assert (train[2].load()[0, 0] == 1).all()
