"""LLFF: axes, resolution, and the two sources of poses."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from clear_strategies.data.readers import llff
from clear_strategies.errors import DataError, SettingError
from tests.helpers import captures as tiny


def test_depths_and_rescaled_cameras_are_noted(tmp_path: Path) -> None:
    capture = llff.read(tiny.llff(tmp_path))
    assert capture.notes["depths"].startswith("1.5 to 9")
    assert "64x48 to 16x12" in capture.notes["cameras"]
    assert capture.points is None


def test_fortran_order_and_float32_are_read_the_same(tmp_path: Path) -> None:
    table = np.load(tiny.llff(tmp_path) / "poses_bounds.npy")
    np.save(tmp_path / "poses_bounds.npy", np.asfortranarray(table.astype(">f4")))
    camera = llff.read(tmp_path).frames[2].camera
    np.testing.assert_allclose(camera.world_to_camera.numpy(), tiny.world_to_camera(2), atol=1e-6)


def test_colmap_is_preferred_and_renamed_photos_are_matched_by_order(tmp_path: Path) -> None:
    tiny.colmap_bin(tmp_path)
    tiny.llff(tmp_path)
    shutil.rmtree(tmp_path / "images")
    for i, name in enumerate(tiny.NAMES):
        (tmp_path / "images_4" / name).rename(tmp_path / "images_4" / f"image{i:03d}.png")
    capture = llff.read(tmp_path)
    assert [frame.name for frame in capture.frames] == ["image000.png", "image001.png", "image002.png"]
    assert [frame.sfm_id for frame in capture.frames] == [1, 2, 3]
    assert capture.notes["names"] == "photos matched to the model's by order (a.png is image000.png)"
    assert capture.points is not None
    (tmp_path / "images_4/image001.png").unlink()
    with pytest.raises(DataError, match="holds 2 images, the model 3 under other names"):
        llff.read(tmp_path)


def test_an_unknown_source_of_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"data\.reader\.poses: must be .* colmap, poses_bounds, got 'best'"):
        llff.read(tiny.llff(tmp_path), poses="best")


@pytest.mark.parametrize(("scene", "views", "size"), [("fern", 20, (1008, 756)), ("horns", 62, (504, 378))])
def test_both_sources_of_poses_agree_up_to_a_similarity(scene, views, size, shared_data):
    ours, theirs = (llff.read(shared_data / scene, poses=poses) for poses in ("colmap", "poses_bounds"))
    assert len(ours.frames) == len(theirs.frames) == views
    assert [f.name for f in ours.frames] == [f.name for f in theirs.frames]
    assert tiny.largest_turn(ours.frames, theirs.frames) < 1
    p, q = (torch.stack([f.camera.center for f in c.frames]) for c in (ours, theirs))
    ratio = torch.pdist(p) / torch.pdist(q)
    assert ratio.max() / ratio.min() < 1.02
    for frame, other in zip(ours.frames, theirs.frames, strict=True):
        assert (frame.camera.width, frame.camera.height) == size
        assert frame.camera.fx == pytest.approx(other.camera.fx, rel=0.02)
    assert tuple(ours.frames[-1].load().shape) == (size[1], size[0], 3)
