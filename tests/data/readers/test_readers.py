"""What each format with poses has of its own: NeRF-synthetic, LLFF, transforms.json, COLMAP models."""

import shutil
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.data import photo_files
from clear_strategies.data.lenses import Lens
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import write_points
from clear_strategies.data.readers import blender, colmap, colmap_model, nerfstudio
from clear_strategies.errors import DataError
from clear_strategies.geometry.projection import project
from tests.helpers import captures as tiny

# ---- NeRF-synthetic: OpenGL poses, RGBA over white, the order and the numbers of the protocol
PROTOCOL = {2, 16, 26, 55, 73, 76, 86, 93}


def test_splits_are_those_of_the_files_and_missing_test_views_are_told(tmp_path: Path, caplog) -> None:
    capture = blender.read(tiny.blender(tmp_path))
    assert [(f.name, f.split) for f in capture.frames] == [("a", "train"), ("b", "train"), ("test/c", "test")]
    assert capture.background == (1.0, 1.0, 1.0)
    (tiny.blender(tmp_path) / "transforms_test.json").unlink()
    assert [frame.split for frame in blender.read(tmp_path).frames] == ["train", "train"]
    assert "no test views" in caplog.text


def test_the_order_is_that_of_the_file_and_endings_may_be_given(tmp_path: Path) -> None:
    tiny.blender(tmp_path)
    for i, name in enumerate(("r_2", "r_10")):
        (tmp_path / "train" / tiny.NAMES[i]).rename(tmp_path / f"train/{name}.png")
    frames = [{"file_path": f"train/{name}.png", "transform_matrix": tiny.opengl(0)} for name in ("r_2", "r_10")]
    tiny.write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 0.7, "frames": frames})
    assert [frame.name for frame in blender.read(tmp_path).frames] == ["r_2", "r_10", "test/c"]


def test_photos_of_one_name_in_several_folders_are_named_with_their_folder(tmp_path: Path) -> None:
    tiny.blender(tmp_path)
    for camera, name in (("left", "a"), ("right", "b")):
        (tmp_path / "train" / camera).mkdir()
        (tmp_path / f"train/{name}.png").rename(tmp_path / f"train/{camera}/0.png")
        text = (tmp_path / "transforms_train.json").read_text()
        (tmp_path / "transforms_train.json").write_text(text.replace(f"train/{name}", f"train/{camera}/0"))
    assert [frame.name for frame in blender.read(tmp_path).frames] == ["left/0", "right/0", "test/c"]


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
    assert not train.load().shown.any()
    assert "1 of 2 photos undistorted" in capture.notes["lens"]
    assert not torch.equal(test.load().image, train.load().image)


def test_the_protocols_frames_of_lego_are_found_by_number(shared_data: Path) -> None:
    frames = {frame.name: frame for frame in blender.read(shared_data / "lego").frames}
    assert set(frames) >= {f"r_{i}" for i in PROTOCOL} | {f"test/r_{i}" for i in range(0, 200, 8)}
    camera = frames["r_2"].camera
    assert camera.fx == pytest.approx(1111.111, abs=1e-3)
    assert camera.center.norm() == pytest.approx(4.031, abs=1e-3)  # on NeRF's sphere around the scene
    assert (-camera.center / camera.center.norm()) @ camera.world_to_camera[2, :3] == pytest.approx(1, abs=1e-5)
    assert (frames["r_2"].load().image[0, 0] == 1).all()


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


def test_frames_are_sorted_by_name_and_their_own_intrinsics_win_over_the_shared_ones(tmp_path: Path) -> None:
    capture = nerfstudio.read(changed(tmp_path, lambda value: value["frames"].reverse()))
    assert [frame.name for frame in capture.frames] == list(tiny.NAMES)
    assert nerfstudio.read(tmp_path / "transforms.json").frames[0].name == "a.png"
    capture = nerfstudio.read(changed(tmp_path, lambda v: v["frames"][1].update(fl_x=30, cx=7.5)))
    assert [frame.camera.fx for frame in capture.frames] == [20, 30, 20]
    assert [frame.camera.cx for frame in capture.frames] == [8, 7.5, 8]


@pytest.mark.parametrize(("photo", "copy"), [((9500, 6333), (1600, 1067)), ((1067, 1600), (6333, 9500))])
def test_a_lens_of_rounded_size_is_that_of_the_photo_and_of_no_other_shape(photo, copy) -> None:
    lens = Lens(*copy, 1000, 1000, 800, 533).resized(*photo, Path("a.jpg"))
    assert (lens.width, lens.height) == photo
    with pytest.raises(DataError, match="another shape"):
        lens.resized(copy[0] * 102 // 100, copy[1], Path("a.jpg"))


def test_the_files_lists_split_the_frames_and_the_rest_is_logged(tmp_path, caplog):
    lists = {"train_filenames": ["images/b.png"], "val_filenames": ["images/a.png"], "test_filenames": []}
    capture = nerfstudio.read(changed(tmp_path, lambda value: value.update(lists)))
    assert [frame.split for frame in capture.frames] == ["test", "train", None]
    assert "1 frame in none of its split lists" in caplog.text


def test_the_masks_it_names_hide_their_black_pixels_and_are_undistorted_with_their_photos(tmp_path: Path) -> None:
    mask = torch.ones(12, 16, 3)
    mask[:, :4] = 0
    write_png(tmp_path / "m.png", mask)
    for lens in ({}, {"camera_model": "OPENCV", "k1": 0.05}):
        named = changed(tmp_path, lambda v, lens=lens: v["frames"][0].update(mask_path="m.png", **lens))
        shown = [frame.load().shown for frame in nerfstudio.read(named).frames]
        assert sum(s is not None for s in shown) == 1
        found = next(s for s in shown if s is not None)
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


# ---- COLMAP models: both layouts give the same scene, lenses are straightened, photos are found
LAYOUTS = {"bin": tiny.colmap_bin, "txt": tiny.colmap_txt}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_photos_and_points_are_those_of_the_files(layout: str, tmp_path: Path) -> None:
    capture = colmap.read(LAYOUTS[layout](tmp_path))
    assert [frame.name for frame in capture.frames] == list(tiny.NAMES)
    assert [frame.sfm_id for frame in capture.frames] == [1, 2, 3]
    for frame in capture.frames:
        assert torch.equal(frame.load().image, photo_files.read_image(tmp_path / "images" / frame.name))
    points = capture.points
    assert points.means.tolist() == [list(p) for p in tiny.POINTS]
    torch.testing.assert_close(points.colors, torch.tensor([[1.0, 0.0, 0.2], [0.0, 0.4, 1.0]]))
    pairs = sorted(zip(points.track_point.tolist(), points.track_image.tolist(), strict=True))
    assert pairs == [(0, 1), (0, 2), (1, 2), (1, 3)]
    assert points.source == "COLMAP sparse/0, 2 points, triangulated from all 3 images"
    assert capture.notes["poses"] == f"COLMAP sparse/0 ({layout}), 3 images"


def test_many_points_take_little_more_memory_than_their_file(tmp_path: Path) -> None:
    """Of 10 million points, plain Python objects would fill 9 GB."""
    tracks = [[point % 7 + k for k in range(point % 4)] for point in range(1_000)]
    records = [
        struct.pack(
            f"<Q3d3BdQ{2 * len(t)}i", p + 5, p, -p, 0.5, p % 256, 1, 2, 0.0, len(t), *(x for i in t for x in (i, 9))
        )
        for p, t in enumerate(tracks)
    ]
    file = tmp_path / "points3D.bin"
    file.write_bytes(struct.pack("<Q", len(tracks)) + b"".join(records))
    tracemalloc.start()
    points = colmap_model.read_points(file)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 6 * file.stat().st_size
    assert points.means[999].tolist() == [999, -999, 0.5]
    assert points.colors[300].mul(255).round().tolist() == [44, 1, 2]
    pairs = list(zip(points.track_point.tolist(), points.track_image.tolist(), strict=True))
    assert pairs == [(point, image) for point, track in enumerate(tracks) for image in track]


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_the_model_is_found_in_every_usual_place(place: str, tmp_path: Path) -> None:
    tiny.colmap_bin(tmp_path / "made")
    (tmp_path / "scene").mkdir()
    shutil.copytree(tmp_path / "made/sparse/0", tmp_path / "scene" / place, dirs_exist_ok=True)
    shutil.copytree(tmp_path / "made/images", tmp_path / "scene/images")
    assert len(colmap.read(tmp_path / "scene").frames) == 3


def test_smaller_photos_rescale_their_cameras_per_axis(tmp_path: Path) -> None:
    tiny.write_photos(tiny.colmap_bin(tmp_path) / "images_2", size=(8, 7))
    capture = colmap.read(tmp_path, images="images_2")
    camera = capture.frames[0].camera
    assert (camera.fx, camera.cx, camera.cy, camera.width, camera.height) == (10, 4, 3.5, 8, 7)
    assert camera.fy == pytest.approx(20 * 7 / 12)
    assert "16x12 to 8x7" in capture.notes["cameras"]


@pytest.mark.parametrize("folder", ["images", "."])
def test_photos_may_all_lie_in_subfolders_with_masks_in_subfolders_of_the_same_names(folder, tmp_path: Path) -> None:
    listing = tiny.colmap_txt(tmp_path) / "sparse/0/images.txt"
    text = listing.read_text()
    for name in tiny.NAMES:
        (tmp_path / folder / f"cam_{name[0]}").mkdir()
        (tmp_path / "images" / name).rename(tmp_path / folder / f"cam_{name[0]}/1.png")
        text = text.replace(f" {name}\n", f" cam_{name[0]}/1.png\n")
    listing.write_text(text)
    for place, grey in (("cam_a/1.png.png", 0.0), ("cam_b/1.png", 1.0)):
        photo_files.write_png(tmp_path / "masks" / place, torch.full((12, 16), grey))
    shutil.copytree(tmp_path / folder / "cam_a", tmp_path / folder / "cam_d")
    capture = colmap.read(tmp_path, folder)
    assert [frame.name for frame in capture.frames] == ["cam_a/1.png", "cam_b/1.png", "cam_c/1.png"]
    assert capture.notes["without pose"] == "1 photo, not used: cam_d/1.png"
    a, b, c = (frame.load().shown for frame in capture.frames)
    assert (bool(a.any()), bool(b.all()), c) == (False, True, None)


def test_a_missing_file_of_points_and_a_quaternion_of_another_length_are_noted(tmp_path: Path) -> None:
    file = tiny.colmap_txt(tmp_path) / "sparse/0/images.txt"
    file.write_text(file.read_text().replace("1 1.0 0.0 0.0 0.0", "1 1.5 0.0 0.0 0.0"))
    (tmp_path / "sparse/0/points3D.txt").unlink()
    capture = colmap.read(tmp_path)
    assert capture.points is None
    assert capture.notes["points"] == "the model has none"
    np.testing.assert_allclose(capture.frames[0].camera.world_to_camera.numpy(), tiny.world_to_camera(0))


LENSES = [
    Lens(160, 120, 150.0, 140.0, 82.0, 57.0, (-0.2, 0.05, 0.002, -0.001)),
    Lens(160, 120, 150.0, 150.0, 80.0, 60.0, (0.15, 0.0, 0.0, 0.0)),
    Lens(160, 120, 100.0, 100.0, 80.0, 60.0, (0.05, -0.01, 0.002, 0.0), fisheye=True),
    Lens(160, 120, 67.0, 67.0, 80.0, 60.0, (-0.29, 0.06, 0.0, 0.0, -0.012)),  # folded by OpenCV's pinhole
    Lens(160, 120, 51.0, 51.0, 81.0, 59.0, (0, 0, 0, 0), fisheye=True),  # 180 degrees: OpenCV finds no pinhole
    Lens(
        160, 120, 54.0, 54.0, 80.0, 60.0, (-0.006, 0.042, -0.04, 0.007), fisheye=True
    ),  # OpenCV's would be 155 degrees wide
]


def distorted(lens: Lens, rays: np.ndarray) -> np.ndarray:
    """Where OpenCV's lens images the rays (x, y, 1)."""
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    if lens.fisheye:
        return cv2.fisheye.distortPoints(rays, K, np.array(lens.distortion))
    points = np.concatenate((rays, np.ones_like(rays[..., :1])), -1).reshape(-1, 3)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(lens.distortion))[0].reshape(rays.shape)


@pytest.mark.parametrize("lens", LENSES, ids=["opencv", "radial", "fisheye", "action", "180", "wide"])
def test_undistortion_is_the_lens_formula_and_leaves_no_border(lens: Lens) -> None:
    """A smooth function of the distorted position, sampled through the new pinhole's rays, is what `undistort` gives."""
    file = Path("scene")
    pinhole = lens.undistorted(file)
    assert type(pinhole.fx) is float  # as the other numbers, not one of NumPy
    assert np.hypot(160 / pinhole.fx, 120 / pinhole.fy) / 2 < np.tan(
        np.radians(71)
    )  # its corners are not stretched without bound
    v, u = np.meshgrid(np.arange(120) + 0.5, np.arange(160) + 0.5, indexing="ij")

    def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack((x / 160, y / 120, 0.5 + 0.4 * np.sin(x / 15) * np.cos(y / 12)), -1)

    photo = torch.from_numpy(picture(u, v).astype(np.float32))
    rays = np.stack(((u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy), -1)
    source = distorted(lens, rays)
    assert source.min() > -1
    assert (source < [161, 121]).all()
    right, down = np.diff(source, axis=1)[:-1], np.diff(source, axis=0)[:, :-1]
    assert (right[..., 0] * down[..., 1] > right[..., 1] * down[..., 0]).all()  # it is not folded
    expected = picture(source[..., 0], source[..., 1])[2:-2, 2:-2]
    found = lens.undistort(photo, pinhole).numpy()[2:-2, 2:-2]
    assert np.abs(found - expected).max() < 5e-3


@pytest.mark.parametrize("reader", [colmap, nerfstudio])
@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_RADIAL", (20.0, 8.0, 6.0, 0.1)),
        ("OPENCV", (20.0, 20.0, 8.0, 6.0, 0.1, 0.01, 0.001, 0.0)),
        ("OPENCV_FISHEYE", (20.0, 20.0, 8.0, 6.0, 0.1, 0.0, 0.0, 0.0)),
    ],
)
def test_distorted_models_become_pinholes_and_are_noted(reader, model, parameters, tmp_path):
    tiny.colmap_bin(tmp_path, model, parameters)
    capture = reader.read(changed(tmp_path, lambda value: value.update(camera_model=model, k1=0.1)))
    assert capture.notes["lens"].startswith("3 of 3 photos undistorted by OpenCV")
    raw = photo_files.read_image(tmp_path / "images/a.png")
    assert capture.frames[0].load().image.shape == raw.shape
    assert not torch.equal(capture.frames[0].load().image, raw)
    assert capture.frames[0].camera.fx != 20


@pytest.mark.parametrize("scene", ["kitchen360", "real_room", "strecha_fountain"])
def test_real_points_project_into_the_photos_that_observe_them(scene: str, shared_data: Path) -> None:
    capture = colmap.read(shared_data / scene)
    points = capture.points
    for frame in capture.frames:
        camera = frame.camera
        observed = points.means[points.track_point[points.track_image == frame.sfm_id]]
        pixels, depth = project(camera, observed)
        x, y = pixels.T
        inside = (depth > 0) & (x > -3) & (x < camera.width + 3) & (y > -3) & (y < camera.height + 3)
        assert len(observed) > 0
        assert inside.float().mean() > 0.99
    assert cv2.imread(str(shared_data / scene / "images" / capture.frames[0].name)).shape == tuple(
        capture.frames[0].load().image.shape
    )
