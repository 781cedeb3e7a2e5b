"""Cameras as files: what a run writes is what is read."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from clear_strategies.data.photo_files import image_size
from clear_strategies.errors import DataError
from clear_strategies.viewing import cameras
from tests.helpers import toy

SCENE = toy.scene(train=3, test=1)


def same(a, b):
    torch.testing.assert_close(a.world_to_camera.double(), b.world_to_camera.double(), atol=1e-6, rtol=0)
    assert (a.fx, a.fy, a.cx, a.cy, a.width, a.height) == pytest.approx((b.fx, b.fy, b.cx, b.cy, b.width, b.height))


def test_what_a_run_writes_is_what_is_read(tmp_path):
    cameras.write_cameras(tmp_path, SCENE)
    found = cameras.read_cameras(tmp_path / cameras.FILE)
    assert [saved.name for saved in found] == [view.name for view in (*SCENE.train, *SCENE.test)]
    assert [saved.split for saved in found] == ["train"] * 3 + ["test"]
    for saved, view in zip(found, (*SCENE.train, *SCENE.test), strict=True):
        same(saved.camera, view.hr.camera)
        assert saved.scale == toy.FACTOR
    assert found[0].photo is not None
    assert image_size(found[0].photo) == (24, 16)
    assert found[3].photo is None


def test_inrias_cameras_are_read(tmp_path):
    entry = {
        "id": 0, "img_name": "a", "width": 40, "height": 20, "position": [0, 0, -4], "rotation": np.eye(3).tolist(),
        "fx": 50, "fy": 50,
    }  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    (found,) = cameras.read_cameras(tmp_path / "cameras.json")
    assert (found.camera.cx, found.camera.cy) == (20, 10)
    assert found.camera.center.tolist() == [0, 0, -4]


TURNED = [{"width": 4, "height": 4, "fx": 4, "fy": 4, "rotation": [[1, 0], [0, 1]], "position": [0, 0, 0]}]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"), ("", "is not valid"), ("[{", "is not valid"), ("[]", "is an empty list"),
        ("[1]", "must be"), ("[{}]", "is missing"), ("{}", "must be `array`"),
        (json.dumps(TURNED), r"\[0\].rotation: must be a 3x3 matrix"),
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
