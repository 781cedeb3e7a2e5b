"""What each format with poses has of its own: NeRF-synthetic, LLFF, transforms.json."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import write_points
from clear_strategies.data.readers import blender, colmap, nerfstudio
from clear_strategies.errors import DataError
from tests.helpers import captures as tiny

# ---- neRF-synthetic: OpenGL poses, RGBA over white, the order and the numbers of the protocol


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


# ---- LLFF's scenes are COLMAP's, with photos under other names


def test_renamed_photos_of_llff_are_matched_by_order(tmp_path: Path) -> None:
    tiny.llff(tmp_path)
    for i, name in enumerate(tiny.NAMES):
        (tmp_path / "images_4" / name).rename(tmp_path / "images_4" / f"image{i:03d}.png")
    capture = colmap.read(tmp_path)
    assert [frame.name for frame in capture.frames] == ["image000.png", "image001.png", "image002.png"]
    assert [frame.sfm_id for frame in capture.frames] == [1, 2, 3]
    assert capture.notes["names"] == "photos matched to the model's by order (a.png is image000.png)"
    assert capture.points is not None
    (tmp_path / "images_4/image001.png").unlink()
    held = r"such as a\.png; it holds 2 others, such as image000\.png"
    with pytest.raises(DataError, match=rf"none of 3 is in .*images_4, {held}: name the folder"):
        colmap.read(tmp_path)


# ---- transforms.json: intrinsics wherever they stand, poses, splits, points


def changed(root: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The tiny scene with another transforms.json."""
    tiny.edit(tiny.nerfstudio(root) / "transforms.json", change)
    return root


def test_frames_are_sorted_by_name(tmp_path: Path) -> None:
    capture = nerfstudio.read(changed(tmp_path, lambda value: value["frames"].reverse()))
    assert [frame.name for frame in capture.frames] == list(tiny.NAMES)
    assert nerfstudio.read(tmp_path / "transforms.json").frames[0].name == "a.png"


def test_a_frames_own_intrinsics_win_over_the_shared_ones(tmp_path: Path) -> None:
    capture = nerfstudio.read(changed(tmp_path, lambda v: v["frames"][1].update(fl_x=30, cx=7.5)))
    assert [frame.camera.fx for frame in capture.frames] == [20, 30, 20]
    assert [frame.camera.cx for frame in capture.frames] == [8, 7.5, 8]


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL"])
def test_distortion_is_removed_and_noted(model: str, tmp_path: Path) -> None:
    capture = nerfstudio.read(changed(tmp_path, lambda value: value.update(camera_model=model, k1=0.05)))
    assert capture.notes["lens"].startswith("3 of 3 photos undistorted")
    assert capture.frames[0].load().shape == (12, 16, 3)


def test_the_files_lists_split_the_frames_and_the_rest_is_logged(tmp_path, caplog):
    lists = {"train_filenames": ["images/b.png"], "val_filenames": ["images/a.png"], "test_filenames": []}
    capture = nerfstudio.read(changed(tmp_path, lambda value: value.update(lists)))
    assert [frame.split for frame in capture.frames] == ["test", "train", None]
    assert "1 frames are in none" in caplog.text


def test_the_masks_it_names_hide_their_black_pixels_and_are_undistorted_with_their_photos(tmp_path: Path) -> None:
    mask = torch.ones(12, 16, 3)
    mask[:, :4] = 0
    write_png(tmp_path / "m.png", mask)
    for lens in ({}, {"camera_model": "OPENCV", "k1": 0.05}):
        named = changed(tmp_path, lambda v, lens=lens: v["frames"][0].update(mask_path="m.png", **lens))
        shown = [frame.shown for frame in nerfstudio.read(named).frames]
        assert sum(s is not None for s in shown) == 1
        found = next(s for s in shown if s is not None)()
        assert found.shape == (12, 16)
        assert not found[:, :3].any()
        assert found[:, 6:].all()


def test_points_of_a_ply_have_no_tracks(tmp_path: Path) -> None:
    changed(tmp_path, lambda value: value.update(ply_file_path="points.ply", applied_transform=[[1, 0, 0, 5]]))
    write_points(tmp_path / "points.ply", torch.tensor([[1.0, 2, 3]]), torch.tensor([[1, 0, 0.2]]))
    points = nerfstudio.read(tmp_path).points
    assert points.means.tolist() == [[1, 2, 3]]
    assert points.colors[0].tolist() == pytest.approx([1, 0, 0.2])
    assert len(points.track_point) == len(points.track_image) == 0
    assert points.source == "points.ply, 1 points without tracks"
