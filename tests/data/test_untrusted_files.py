"""Files that would hang, fill the memory, lead out of the data set or run something: refused in one line."""

from __future__ import annotations

import html
import os
from pathlib import Path

import pytest
import torch
from PIL import Image

from clear_strategies.data import ply
from clear_strategies.data.cameras import pose_from_opengl
from clear_strategies.data.photo_files import image_size, inside
from clear_strategies.data.readers import colmap
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError, SettingError
from clear_strategies.jobs.lock import hold
from clear_strategies.report.table import Table, aligned
from clear_strategies.settings import build
from rasterizers import Camera
from tests.helpers.malformed import GOOD


def test_a_photo_of_another_ending_that_leads_out_is_refused(tmp_path: Path) -> None:
    scene = GOOD["colmap"](tmp_path / "scene")
    photo = scene / "images" / "b.png"
    photo.rename(tmp_path / "secret.png")
    (scene / "images" / "b.jpg").symlink_to(tmp_path / "secret.png")  # the model names b.png
    with pytest.raises(DataError, match="leads out of"):
        colmap.read(scene)
    assert len(colmap.read(scene, allow_outside=True).frames) == 3


@pytest.mark.parametrize("name", ["sparse/0/cameras.bin", "sparse/0/points3D.bin", "images/b.png"])
def test_a_pipe_is_refused_at_once(name: str, tmp_path: Path) -> None:
    scene = GOOD["colmap"](tmp_path)
    (scene / name).unlink()
    os.mkfifo(scene / name)
    with pytest.raises(DataError, match=r"is a pipe, a device or a socket|1 of 3 are not there: b.png"):
        colmap.read(scene)


@pytest.mark.parametrize("read", [read_object, ply.read_points, image_size])
def test_a_device_without_end_is_refused_at_once(read, tmp_path: Path) -> None:
    path = tmp_path / "endless"
    path.symlink_to("/dev/zero")
    with pytest.raises(DataError, match="is a pipe, a device or a socket"):
        read(path)


def test_an_image_that_decodes_to_hundreds_of_times_its_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    Image.new("L", (9_990, 9_990)).save(path)
    with pytest.raises(DataError, match="more than 200 times the file, as in no photo"):
        image_size(path)
    drawing = tmp_path / "drawing.png"
    Image.new("L", (3_000, 2_000)).save(drawing)
    assert image_size(drawing) == (3_000, 2_000)


@pytest.mark.parametrize("name", ["x" * 300 + ".png", "é" * 200 + ".png", "a/" + "y" * 256])
def test_a_name_that_no_file_system_has_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is no file name"):
        inside(tmp_path, name, file=tmp_path / "images.txt")


def test_an_ascii_ply_without_vertices_is_read(tmp_path: Path) -> None:
    path = tmp_path / "none.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    assert len(ply.read_points(path)) == 0


def test_a_camera_farther_than_float32_resolves_is_refused() -> None:
    pose = [[1.0, 0, 0, 1e17], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    with pytest.raises(DataError, match="no 3x4 or 4x4 matrix of finite numbers"):
        pose_from_opengl(Path("transforms.json"), "frames[0]", pose)


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p.mul_(0),
        lambda p: p[:3, :3].mul_(2),
        lambda p: p[0].neg_(),
        lambda p: p[0, 1].add_(0.1),
        lambda p: p[3, 3].mul_(2),
    ],
    ids=["zero", "scaled", "reflected", "sheared", "last row"],
)
def test_a_pose_that_is_not_rigid_is_refused(change) -> None:
    pose = torch.eye(4)
    change(pose)
    with pytest.raises(ValueError, match="must be a rotation and a translation"):
        Camera(pose, 10.0, 10.0, 5.0, 5.0, 10, 10)


def test_a_lock_that_is_a_dangling_link_creates_nothing_outside(tmp_path: Path) -> None:
    run, outside = tmp_path / "run", tmp_path / "outside"
    run.mkdir()
    (run / "run.lock").symlink_to(outside)
    with pytest.raises(DataError, match="is a link or no regular file"), hold(run):
        pass
    assert not outside.exists()


def test_a_name_in_a_report_is_text_and_no_markup() -> None:
    rows = "\n".join(aligned({"scene": ["<script>alert(1)</script>"], "method": ["a|b\nc"]}))
    assert "<script>" not in rows
    assert html.escape("<script>") in rows
    assert "a\\|b c" in rows
    assert "<img" not in Table({"scene": ["x"]}, ["All runs of x: `<img src=y>`."]).markdown


@pytest.mark.parametrize(
    "target",
    [
        "pathlib.Path.write_text", "os.system", "subprocess.run", "builtins.exec", "torch.load", "numpy.load", "runpy.run_path",
        "clear_strategies.files.write_text", "clear_strategies.files.sweep", "clear_strategies.files.Path",
        "clear_strategies.data.ply.write_gaussians", "clear_strategies.training.checkpoint.Path.write_text",
        "torch.utils.cpp_extension.load", "clear_strategies.jobs.lock.hold", "rasterizers.native.importlib.import_module",
    ],
)  # fmt: skip
@pytest.mark.parametrize("partial", [False, True])
def test_a_target_that_is_no_setting_is_refused_before_it_is_called(target: str, partial: bool, tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    node = {"_target_": target, "_partial_": partial, "path": str(canary), "data": "x", "self": str(canary)}
    with pytest.raises(SettingError, match=r"^strategies.mine: .*(must name a class|is no class|cannot be imported)"):
        build(node, "strategies.mine")
    assert not canary.exists()
