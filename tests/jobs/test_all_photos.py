"""What a capture is by default: all of its photos. What it is under a protocol: the same bits for ever."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from clear_strategies.commands import train
from clear_strategies.compose import composed, tree
from clear_strategies.data.scene import Scene
from clear_strategies.data.view_settings import split
from clear_strategies.jobs.scene import load
from clear_strategies.jobs.settings import JobSettings, settings_of
from tests.helpers import captures


def settings(*overrides: str) -> JobSettings:
    return settings_of(tree(composed([*overrides, "prior=bicubic", "data.cloud.init=random"], "config")))


def used_by_default(folder: Path) -> tuple[int, int, int]:
    """How many photos `clear-strategies train FOLDER` finds, trains on and tests on."""
    data = settings(*train.overrides([str(folder)])).data
    capture = data.reader()
    pool, test = split(capture, data.views)
    return len(capture.frames), len(pool), len(test)


@pytest.mark.parametrize("write", [captures.colmap_bin, captures.colmap_txt, captures.llff, captures.nerfstudio])
def test_every_readers_default_trains_on_all_photos(write: Callable[[Path], Path], tmp_path: Path) -> None:
    assert used_by_default(write(tmp_path)) == (3, 3, 0)


def test_a_split_of_the_data_sets_own_leaves_no_photo_out(tmp_path: Path) -> None:
    assert used_by_default(captures.blender(tmp_path)) == (3, 2, 1)


@pytest.mark.parametrize(
    ("name", "found"),
    [("kitchen360", (24, 24, 0)), ("real_room", (35, 35, 0)), ("fern", (20, 20, 0)), ("lego", (50, 25, 25))],
)
def test_the_real_scenes_are_used_whole(name: str, found: tuple[int, int, int], shared_data: Path) -> None:
    assert used_by_default(shared_data / name) == found


# As commit d8541c9 read them, the last before the readers took all photos by default. LLFF's and COLMAP's scene are the same.
PROTOCOLS = {
    "llff_x4": (captures.llff, ["data.views.train=2"], "46168a5e571aae82"),
    "mip360_x4": (captures.colmap_bin, ["data.views.train=2"], "46168a5e571aae82"),
    "blender_x4": (captures.blender, ["data.views.train_names=[b,a]"], "713820e4480d9b58"),
}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_under_a_protocol_photos_and_cameras_keep_their_bits(
    protocol: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clear_strategies.data.prepare.SMALLEST", 1)  # px that scores need, more than these photos have
    write, changed, expected = PROTOCOLS[protocol]
    scene = write(tmp_path / "scene").name
    job = settings(f"+protocol={protocol}", f"data.root={tmp_path}", f"data.scene={scene}", *changed)
    assert fingerprint(load(job.data, job.prior, 0)) == expected


def fingerprint(scene: Scene) -> str:
    """Of the LR and HR photos in 8 bits, and of the cameras; poses to six digits, since libraries differ in the last."""
    digest = hashlib.sha256()
    for part in (scene.train, scene.test):
        for view in part:
            for image in (view.lr.image, view.truth):
                digest.update((image * 255).round().to(torch.uint8).numpy().tobytes())
            for camera in (view.lr.camera, view.hr.camera):
                size = (
                    camera.width, camera.height, *(round(x, 6) for x in (camera.fx, camera.fy, camera.cx, camera.cy)),
                )  # fmt: skip
                pose = [[round(x, 6) + 0.0 for x in row] for row in camera.world_to_camera.tolist()]
                digest.update(json.dumps([view.name, size, pose]).encode())
    return digest.hexdigest()[:16]
