"""Depth from files: its pixels through any lens, crop and refined camera; its unit; and files that hold something else."""

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from clear_strategies import DataError
from clear_strategies.data.capture import Frame
from clear_strategies.data.cloud import CloudSettings, initial_points
from clear_strategies.data.depth_files import DepthFile, depth_files
from clear_strategies.data.lenses import Lens
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.prepare import prepare
from clear_strategies.data.priors import Bicubic
from clear_strategies.data.readers import demo
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.errors import SettingError
from clear_strategies.geometry import StereoSettings
from rasterizers import Camera
from tests.helpers.planes import camera, plane_photos

SETTINGS = CloudSettings(init="stereo", stereo=StereoSettings(max_planes=64), densify=False, outlier_neighbours=0)


def frame(name: str = "a.jpg", seen: Camera | None = None) -> Frame:
    return Frame(name, seen or camera(0.0), lambda: pytest.fail("a photo was decoded"))


def rays(lens: Lens) -> np.ndarray:
    """Return x / z and y / z of each pixel of an image through the lens, by OpenCV's iterative inverse."""
    grid = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), -1).reshape(-1, 1, 2).astype(np.float64)
    inverse = cv2.fisheye.undistortPoints if lens.fisheye else cv2.undistortPoints
    return inverse(grid, lens.matrix(), lens.coefficients).reshape(lens.height, lens.width, 2)


@pytest.mark.parametrize(
    "distortion",
    [(), (-0.2, 0.05, 0.002, -0.001), (0.1, 0.0, 0.0, 0.0, 0.02), (0.05, -0.01, 0.0, 0.0)],
    ids=["pinhole", "barrel", "pincushion", "fisheye"],
)
@pytest.mark.parametrize("refined", [False, True])
def test_depth_is_that_of_the_photos_pixel_through_any_lens_size_crop_and_refined_camera(
    tmp_path, distortion, refined, request
):
    fisheye = "fisheye" in request.node.name
    lens = Lens(400, 300, 350.0, 340.0, 190.0, 160.0, distortion, fisheye)
    write_png(tmp_path / "a.png", torch.zeros(300, 400, 3))
    taken = Frame.of_photo("a.png", tmp_path / "a.png", lens, torch.eye(4, dtype=torch.float64))
    pinhole = taken.camera
    if refined:  # the photo keeps its pixels
        better = replace(taken.camera, fx=1.1 * pinhole.fx, fy=1.2 * pinhole.fy, cx=pinhole.cx + 9, cy=pinhole.cy - 7)
        taken = replace(taken, camera=better)
    x, y = rays(lens.resized(800, 600, Path())).transpose(2, 0, 1)
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth" / "a.npy", 4 + x + 2 * y)
    (file,) = depth_files(tmp_path / "depth", [taken])
    lr = replace(taken.camera, width=396, height=296).scaled(1 / 4)
    found = file.at(lr).numpy()
    column, row = np.meshgrid(4 * np.arange(99) + 2.0, 4 * np.arange(74) + 2.0)
    expected = 4 + (column - pinhole.cx) / pinhole.fx + 2 * (row - pinhole.cy) / pinhole.fy
    assert found.shape == (74, 99)
    inside = slice(int(fisheye), None)  # OpenCV's pinhole of a fisheye reaches two pixels beyond its upper edge
    np.testing.assert_allclose(found[inside], expected[inside], atol=3.5 / 700)  # of half a pixel of the file


def half_flat(count: int = 3) -> list:
    """Photos of the plane at z = 4 whose lower half has no texture."""
    photos = plane_photos(count, 96, 72)
    for one in photos:
        one.image[36:] = 0.5
    return photos


def written(folder: Path, photos: list, values: dict[int, np.ndarray] | None = None) -> list[DepthFile]:
    """A 16-bit PNG of z = 4 in a unit of 1/700 at half the photos' size; or other values of some photos."""
    for i in range(len(photos)):
        depth = np.full((36, 48), 2_800, np.uint16)
        depth[:, :3] = 0
        cv2.imwrite(str(folder / f"{i}.png"), (values or {}).get(i, depth))
    return depth_files(folder, [frame(f"{i}.jpg", one.camera) for i, one in enumerate(photos)])


def test_files_in_any_unit_complete_stereo_where_there_is_no_texture(tmp_path, caplog):
    caplog.set_level("INFO")
    photos = half_flat()
    files = written(tmp_path, photos)
    stereo, completed = (initial_points(SETTINGS, photos, files=chosen) for chosen in ((), files))
    for before, after in zip(stereo.depths, completed.depths, strict=True):
        assert not before.known[44:].any()
        assert after.known[:, 6:].all()
        assert torch.equal(after.depth[before.known], before.depth[before.known])
        assert ((after.depth[after.known] / 4 - 1).abs() < 0.03).float().mean() > 0.97
    assert (completed.cloud.means[:, 1] > 0.4).sum() > 9 * (stereo.cloud.means[:, 1] > 0.4).sum() + 100
    assert stereo.cloud.uses_test_views == "no"
    assert completed.cloud.uses_test_views == "unknown"
    assert completed.cloud.source.endswith("with depth files")
    assert "multiplied by 0.00142" in caplog.text or "multiplied by 0.00143" in caplog.text


def test_a_file_that_contradicts_the_photos_is_left_out_and_told(tmp_path, caplog):
    photos = half_flat()
    ramp = np.linspace(1_000, 9_000, 36 * 48).reshape(36, 48).astype(np.uint16)
    files = written(tmp_path, photos, {1: ramp})
    depths = initial_points(SETTINGS, photos, files=files).depths
    assert [bool(depth.known[44:].any()) for depth in depths] == [True, False, True]
    assert "1 of 3 depth files differ" in caplog.text
    assert "1.png (" in caplog.text


@pytest.mark.parametrize(("dtype", "depth"), [("uint16", 4_000), ("float32", 4.0)])
def test_without_stereo_whole_numbers_are_millimetres_and_others_world_units(tmp_path, caplog, dtype, depth):
    photos = [replace(one, image=torch.full_like(one.image, 0.5)) for one in plane_photos(2, 48, 36)]
    for i in range(2):
        np.save(tmp_path / f"{i}.npy", np.full((36, 48), depth, dtype))
    files = depth_files(tmp_path, [frame(f"{i}.jpg", one.camera) for i, one in enumerate(photos)])
    found = initial_points(SETTINGS, photos, files=files)
    assert torch.allclose(found.cloud.means[:, 2], torch.tensor(4.0))
    assert "do not tell the unit" in caplog.text


def test_hidden_pixels_and_a_plain_background_have_no_depth(tmp_path):
    photos = half_flat()
    for one in photos:
        one.image[60:] = 1.0
    photos[0] = replace(photos[0], shown=torch.arange(72)[:, None].expand(72, 96) < 50)
    depths = initial_points(SETTINGS, photos, files=written(tmp_path, photos), background=(1.0, 1.0, 1.0)).depths
    assert [bool(depth.known[54:58].any()) for depth in depths] == [False, True, True]
    assert not any(depth.known[60:].any() for depth in depths)


def test_a_prepared_scene_has_the_depth_of_the_files(tmp_path, caplog):
    capture = demo.read(width=64, height=48)
    for one in capture.frames:
        np.save(tmp_path / f"{one.name}.npy", np.full((48, 64), 7.0))
    settings = CloudSettings(depth=str(tmp_path))
    views = ViewSettings(train=3, test_every=8, sr_scale=2)
    scene = prepare(capture, views, Bicubic(), settings)
    assert "depth files" in caplog.text
    alone = prepare(capture, views, Bicubic(), CloudSettings())
    assert all(a.depth.coverage >= b.depth.coverage for a, b in zip(scene.train, alone.train, strict=True))
    (tmp_path / f"{scene.train[1].name}.npy").unlink()
    with pytest.raises(DataError, match=rf"has no depth file {scene.train[1].name} .*: give each training photo"):
        prepare(capture, views, Bicubic(), settings)


def npy(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.png", b"no picture", "cannot be decoded"),
        ("a.png", cv2.imencode(".png", np.zeros((100, 100), np.uint8))[1].tobytes(), "holds uint8 of shape"),
        ("a.png", cv2.imencode(".png", np.zeros((9, 9, 3), np.uint16))[1].tobytes(), r"shape \[9, 9, 3\]"),
        ("a.npy", b"\x93NUMPY", "cannot be read"),
        ("a.npy", npy(np.array({"depth": 1}, dtype=object)), "cannot be read"),
        ("a.npy", npy(np.ones((100, 50))), "is 50x100, but its camera is for 100x100"),
        ("a.npy", npy(np.ones((100, 100), bool)), "holds bool"),
    ],
)
def test_what_is_no_depth_is_refused(tmp_path, name, content, problem):
    (tmp_path / name).write_bytes(content)
    (file,) = depth_files(tmp_path, [frame()])
    with pytest.raises(DataError, match=problem):
        file.at(camera(0.0))


def test_each_photo_has_one_file_of_its_own(tmp_path):
    for name in ("a.npy", "a.png", "b.npy"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(DataError, match=r"a: has a\.npy and a\.png for one view"):
        depth_files(tmp_path, [frame()])
    with pytest.raises(
        DataError, match=r"that of two views, left/b\.jpg and right/b\.jpg: put the depth files into subfolders"
    ):
        depth_files(tmp_path, [frame("left/b.jpg"), frame("right/b.jpg")])
    with pytest.raises(DataError, match=r"nowhere: folder: is not there"):
        depth_files(tmp_path / "nowhere", [frame()])
    with pytest.raises(SettingError, match=r"data\.cloud\.depth: .*init=stereo and auto.*leave out init=random"):
        CloudSettings(init="random", depth="here")
