"""transforms.json: intrinsics wherever they stand, poses, splits, points."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import write_points
from clear_strategies.data.readers import nerfstudio
from tests.helpers import captures as tiny


def changed(root: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The tiny scene with another transforms.json."""
    value = json.loads((tiny.nerfstudio(root) / "transforms.json").read_text())
    change(value)
    tiny.write_json(root / "transforms.json", value)
    return root


def test_frames_are_sorted_by_name(tmp_path: Path) -> None:
    capture = nerfstudio.read(changed(tmp_path, lambda value: value["frames"].reverse()))
    assert [frame.name for frame in capture.frames] == list(tiny.NAMES)
    assert nerfstudio.read(tmp_path / "transforms.json").frames[0].name == "a.png"


def test_a_frames_own_intrinsics_win_over_the_shared_ones(tmp_path: Path) -> None:
    capture = nerfstudio.read(changed(tmp_path, lambda v: v["frames"][1].update(fl_x=30, cx=7.5)))
    assert [frame.camera.fx for frame in capture.frames] == [20, 30, 20]
    assert [frame.camera.cx for frame in capture.frames] == [8, 7.5, 8]


def test_instant_ngp_gives_angles_and_leaves_out_endings(tmp_path: Path) -> None:
    def change(value: dict[str, Any]) -> None:
        frames = [{**frame, "file_path": frame["file_path"][:-4]} for frame in value["frames"]]
        value.clear()
        value.update(camera_angle_x=2 * np.arctan(0.4), aabb_scale=16, frames=frames)

    camera = nerfstudio.read(changed(tmp_path, change)).frames[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((20, 20, 8, 6))


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


def test_photos_of_one_name_keep_their_subfolders_and_masks_lie_in_the_same(tmp_path: Path) -> None:
    def rig(value: dict[str, Any]) -> None:
        for folder, frame in zip(("back", "left", "right"), value["frames"], strict=True):
            (tmp_path / "images" / folder).mkdir()
            (tmp_path / frame["file_path"]).rename(tmp_path / "images" / folder / "1.png")
            write_png(tmp_path / "masks" / folder / "1.png", torch.zeros(12, 16))
            frame["file_path"] = f"images/{folder}/1.png"

    frames = nerfstudio.read(changed(tmp_path, rig)).frames
    assert [frame.name for frame in frames] == ["back/1.png", "left/1.png", "right/1.png"]
    assert all(frame.shown is not None and not frame.shown().any() for frame in frames)


def test_points_of_a_ply_have_no_tracks(tmp_path: Path) -> None:
    changed(tmp_path, lambda value: value.update(ply_file_path="points.ply", applied_transform=[[1, 0, 0, 5]]))
    write_points(tmp_path / "points.ply", torch.tensor([[1.0, 2, 3]]), torch.tensor([[1, 0, 0.2]]))
    points = nerfstudio.read(tmp_path).points
    assert points.means.tolist() == [[1, 2, 3]]
    assert points.colors[0].tolist() == pytest.approx([1, 0, 0.2])
    assert len(points.track_point) == len(points.track_image) == 0
    assert points.source == "points.ply, 1 points without tracks"
