"""docs/how-to/captures.md: each tool of its table, by small files as it writes them, is read as the table says."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.commands.train import detect
from clear_strategies.data.ply import write_points
from clear_strategies.data.readers import photos
from clear_strategies.errors import DataError
from tests.helpers import captures as tiny
from tests.helpers.captures import FOCAL, HEIGHT, NAMES, WIDTH

PAGE = Path(__file__).resolve().parents[3] / "docs" / "how-to" / "captures.md"
ROW = re.compile(r"^\| (?P<tool>[^|]+) \| [^|]+ \| (?:`data=(?P<kind>\w+)`|–) \| [^|]+ \|$")
ROWS = {found["tool"]: found["kind"] for line in PAGE.read_text().splitlines() if (found := ROW.match(line))}
LENS = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}


def colmap4(root: Path) -> None:
    """A model that pycolmap wrote, which is COLMAP 4: with rigs and frames, as binary files."""
    pycolmap = pytest.importorskip("pycolmap", "4.0")
    listing = tiny.colmap_txt(root) / "sparse/0/images.txt"
    listing.write_text(listing.read_text().replace("a.png\n\n", "a.png\n8.0 6.0 1\n").replace("6.0 -1", "6.0 2", 1))
    points = "".join(f"{i} {i} 0 3 255 0 0 0.5 {i} 0\n" for i in (1, 2))  # whose tracks agree with the images
    (root / "sparse/0/points3D.txt").write_text(points)
    model = pycolmap.Reconstruction(str(root / "sparse/0"))
    for file in (root / "sparse/0").iterdir():
        file.unlink()
    model.write_binary(str(root / "sparse/0"))
    assert {"rigs.bin", "frames.bin"} <= {file.name for file in (root / "sparse/0").iterdir()}


def reality_capture(root: Path) -> None:
    """Capital letters, a byte order mark, lines as on Windows, and the photos beside them."""
    tiny.colmap_txt(root)
    for name in ("Cameras", "Images", "Points3D"):
        text = (root / f"sparse/0/{name[0].lower()}{name[1:]}.txt").read_bytes()
        (root / f"{name}.txt").write_bytes(b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n"))
    shutil.rmtree(root / "sparse")
    for photo in (root / "images").iterdir():
        photo.rename(root / photo.name)
    (root / "images").rmdir()


def of_each_frame(root: Path) -> None:
    """As nerfstudio converts Metashape's, Polycam's and Record3D's: a lens of each frame, depth beside it."""
    root.mkdir(parents=True)
    tiny.write_photos(root / "images")
    frames = [
        {**LENS, "file_path": f"./images/{n}", "depth_file_path": f"./depth/{n}", "transform_matrix": tiny.opengl(i)}
        for i, n in enumerate(NAMES)
    ]
    more = {"camera_model": "OPENCV", "k1": 0, "applied_transform": [[1, 0, 0, 0]]}
    tiny.write_json(root / "transforms.json", {**more, "frames": frames})


def nerfstudio_own(root: Path) -> None:
    tiny.nerfstudio(root)
    write_points(root / "sparse_pc.ply", torch.ones(2, 3), torch.zeros(2, 3))
    more = {"ply_file_path": "sparse_pc.ply", "train_filenames": ["images/a.png"]}
    tiny.edit(root / "transforms.json", lambda v: v.update(more))


def instant_ngp(root: Path) -> None:
    tiny.write_photos(root / "images")
    frames = [
        {"file_path": f"./images/{name[:-4]}", "sharpness": 30.1, "transform_matrix": tiny.opengl(i)}
        for i, name in enumerate(NAMES)
    ]
    lens = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL), "k1": 0.0, "k2": 0.0, "is_fisheye": False}
    tiny.write_json(root / "transforms.json", {**lens, "w": 16.0, "h": 12.0, "aabb_scale": 32, "frames": frames})


def blender_nerf(root: Path) -> None:
    tiny.write_photos(root / "train", mode="RGBA")
    frames = [{"file_path": f"train/{name}", "transform_matrix": tiny.opengl(i)} for i, name in enumerate(NAMES)]
    write_points(root / "points3d.ply", torch.ones(2, 3), torch.zeros(2, 3))
    more = {"camera_angle_x": 0.8, "camera_angle_y": 0.6, "aabb_scale": 16, "ply_file_path": "points3d.ply"}
    tiny.write_json(root / "transforms_train.json", {**LENS, **more, "frames": frames})


WRITE: dict[str, Callable[[Path], object]] = {
    "COLMAP 3": tiny.colmap_bin, "COLMAP 4": colmap4, "RealityCapture": reality_capture, "Metashape": of_each_frame,
    "Polycam": of_each_frame, "Record3D": of_each_frame, "nerfstudio": nerfstudio_own, "instant-ngp": instant_ngp,
    "BlenderNeRF": blender_nerf, "LLFF": tiny.llff,
}  # fmt: skip
POINTS = ("COLMAP 3", "COLMAP 4", "RealityCapture", "nerfstudio", "BlenderNeRF", "LLFF")


def test_the_table_has_every_tool() -> None:
    assert set(ROWS) == {*WRITE, "plain photos", "videos"}


@pytest.mark.parametrize("tool", WRITE)
def test_a_tools_files_are_read_as_the_table_says(tool: str, tmp_path: Path) -> None:
    root = tmp_path / "capture"
    WRITE[tool](root)
    assert detect(root) == ROWS[tool]
    capture = tiny.READERS[ROWS[tool]](root)
    tiny.require_poses(capture)
    assert (capture.points is not None and len(capture.points.means) == 2) == (tool in POINTS)


def test_plain_photos_have_their_poses_estimated_and_a_video_is_answered_with_the_line_that_takes_frames(
    tmp_path: Path,
) -> None:
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (16, 12)).save(tmp_path / "photos/a.jpg")
    assert detect(tmp_path / "photos") == ROWS["plain photos"] == "photos"
    (tmp_path / "clip.mp4").write_bytes(b"")
    with pytest.raises(DataError, match="ffmpeg -i VIDEO -vf thumbnail=15 -fps_mode passthrough"):
        photos.read(tmp_path / "clip.mp4")
