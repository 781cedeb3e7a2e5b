"""Captures as other tools write them, in small: what is read of each, and what the message is where it is not."""

import math
import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.commands.train import detect
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import write_points
from clear_strategies.data.prepare import prepare
from clear_strategies.data.priors import Bicubic
from clear_strategies.data.readers import colmap, demo, nerfstudio, photos
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.errors import DataError
from clear_strategies.jobs import scene
from tests.helpers import captures as tiny
from tests.helpers.captures import FOCAL, GOOD, HEIGHT, NAMES, READERS, WIDTH

# ---- names: one rule for all readers
NAMED: dict[str, tuple[Callable[[str], str], Callable[[Path], object]]] = {
    "backslashes": (lambda name: name.replace("/", "\\"), lambda _: None),
    "another ending": (lambda name: name.replace(".png", ".JPG"), lambda _: None),
    "no ending": (lambda name: name.removesuffix(".png"), lambda _: None),
    "no ending of a jpeg": (
        lambda name: name.removesuffix(".png"),
        lambda file: Image.open(file).convert("RGB").save(file.with_suffix(".jpg")) or file.unlink(),
    ),
    "another case": (str.upper, lambda _: None),
    "capital ending of the file": (lambda name: name, lambda file: file.rename(file.with_suffix(".PNG"))),
    "the folder's own name first": (lambda name: name if "/" in name else f"images/{name}", lambda _: None),
    "absolute of another machine": (lambda name: f"C:\\scans\\room\\{name}", lambda _: None),
}


@pytest.mark.parametrize(
    ("kind", "case"),
    [
        *(("colmap_txt", case) for case in [*NAMED, "absolute"]),
        *((k, "backslashes") for k in ("blender", "nerfstudio")),
    ],
)
def test_a_photo_is_found_however_its_name_is_written(kind: str, case: str, tmp_path: Path) -> None:
    folder = tmp_path / "scene" / ("train" if kind == "blender" else "images")
    rename, spoil = NAMED.get(case, (lambda name: f"{folder}/{Path(name).name}", lambda _: None))
    root = GOOD[kind](tmp_path / "scene", rename)
    for name in NAMES:
        spoil(folder / name)
    capture = READERS[kind](root)
    tiny.require_poses(capture)
    assert [Path(frame.name).stem for frame in capture.frames] == ["a", "b", "c"]


def test_masks_points_and_split_lists_are_found_by_the_same_rule_and_depth_files_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    root = tiny.nerfstudio(tmp_path)
    write_points(root / "points.ply", torch.zeros(1, 3), torch.zeros(1, 3))
    (root / "m").mkdir()
    Image.new("L", (tiny.WIDTH, tiny.HEIGHT)).save(root / "m/a.png")

    def change(value: dict[str, Any]) -> None:
        value.update(ply_file_path=".\\Points.ply", train_filenames=["images\\a.png", "images\\b.png"])
        value["frames"][0]["mask_path"] = "m\\A.png"
        value["frames"][1]["depth_file_path"] = ".\\depth\\b.png"

    tiny.edit(root / "transforms.json", change)
    capture = nerfstudio.read(root)
    assert len(capture.points.means) == 1
    assert [frame.split for frame in capture.frames] == ["train", "train", None]
    assert not capture.frames[0].load().shown.any()
    assert f"data.cloud.depth={root / 'depth'}." in caplog.text


def test_two_files_that_a_name_could_mean_are_not_chosen_from(tmp_path: Path) -> None:
    folder = tiny.colmap_txt(tmp_path) / "images"
    (folder / "a.png").rename(folder / "a.webp")
    (folder / "a.webp").with_suffix(".tif").write_bytes(b"")
    with pytest.raises(DataError, match=r"photos: 1 of 3 are not there: a\.png"):
        colmap.read(tmp_path)


@pytest.mark.parametrize(
    ("moved", "message"),
    [
        ("images/cam0", r"images, such as a\.png; it holds 3 others, such as cam0/a\.png: .*data\.reader\.images=(\S+)"),
        (
            "photos",
            r"none of the folders images, .*, but photos holds 3, more/cam2 holds 3: name .*: data\.reader\.images=FOLDER",
        ),
    ],
)  # fmt: skip
def test_where_no_photo_is_there_the_message_says_what_is(moved: str, message: str, tmp_path: Path) -> None:
    root = tiny.colmap_txt(tmp_path)
    (root / moved).mkdir()
    for name in NAMES:
        (root / "images" / name).rename(root / moved / name)
    if moved == "photos":
        (root / "images").rmdir()
        shutil.copytree(root / moved, root / "more/cam2")
    with pytest.raises(DataError, match=message):
        colmap.read(root)
    assert len(colmap.read(root, images=moved).frames) == 3  # the remedy


@pytest.mark.parametrize("beside", [True, False])
def test_where_only_reduced_photos_of_nerfstudio_are_there_the_message_names_the_setting(
    beside: bool, tmp_path: Path
) -> None:
    """As DL3DV is downloaded; and where the names have no folder."""
    root = tiny.nerfstudio(tmp_path, listed=lambda name: Path(name).name if beside else name)
    (root / "images").rename(root / "images_4")
    with pytest.raises(DataError, match=r"such as images_4/a\.png: name .*: data\.reader\.images=images_4$"):
        nerfstudio.read(root)
    tiny.require_poses(nerfstudio.read(root, images="images_4"))  # the remedy


def test_where_photos_have_an_ending_that_is_not_read_the_message_names_it(tmp_path: Path) -> None:
    root = tiny.nerfstudio(tmp_path)
    for name in NAMES:
        (root / "images" / name).rename((root / "images" / name).with_suffix(".CR2"))
    for skip_faulty in (False, True):
        told = (
            r"transforms\.json: photos: none of 3 is in .*images, such as a\.png; it holds 3 \.CR2: .* as PNG or JPEG"
        )
        with pytest.raises(DataError, match=told):
            nerfstudio.read(root, skip_faulty=skip_faulty)


# ---- poses that no reader reads beside photos
BESIDE: dict[str, tuple[str, str, str]] = {
    "transform_train.json": ("transform_train.json", '{"frames": []}', "clear-strategies train .*transform_train.json"),
    "Metashape": ("cameras.xml", '<?xml version="1.0"?>\n<document><chunk>', "ns-process-data metashape"),
    "RealityCapture's table": ("cameras.csv", "#name,x,y,alt,heading,pitch,roll,f\n", "ns-process-data realitycapture"),
    "RealityCapture's XMP": ("a.xmp", '<rdf:Description xcr:PosePrior="initial">', "export Cameras.txt"),
    "Polycam's keyframes": ("cameras/1.json", '{"t_00": 1.0}', "ns-process-data polycam"),
    "LLFF": ("poses_bounds.npy", "\x93NUMPY", "sparse/0"),
    "COLMAP's undistorter": ("dense/sparse/cameras.bin", "", "sparse/0"),
    "COLMAP's, beside the photos": ("../sparse/0/cameras.bin", "", "/.."),
    "nerfstudio's, beside the photos": ("../transforms.json", '{"frames": []}', "/.."),
}


@pytest.mark.parametrize("what", BESIDE)
def test_poses_that_are_not_read_are_told_before_new_ones_are_estimated(what, tmp_path, monkeypatch, caplog):
    (name, text, remedy), tmp_path = BESIDE[what], tmp_path / "capture"
    tiny.write_photos(tmp_path / "images")
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text, encoding="latin-1")

    def estimate(*_: object) -> None:
        assert "they are estimated anew, at another scale" in caplog.text
        raise DataError(tmp_path, "poses", "would be estimated", "")

    monkeypatch.setattr(photos.sfm, "reconstruct", estimate)
    with pytest.raises(DataError, match="would be estimated"):
        photos.read(tmp_path, tmp_path.parent / "cache")
    (warning,) = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert remedy.split(".*")[0] in warning
    assert name in warning


def test_transforms_under_any_name_are_read_when_the_file_is_named(tmp_path: Path) -> None:
    file = tiny.nerfstudio(tmp_path) / "transforms.json"
    file = file.rename(tmp_path / "transform_train.json")
    assert detect(file) == "nerfstudio"
    tiny.require_poses(nerfstudio.read(file))


# ---- nothing is dropped in silence
@pytest.mark.parametrize("names", [NAMES, ("a photo 1.png", "b photo 2.png", "c photo 3.png")])
@pytest.mark.parametrize(
    "points", ["", "\n", "8.0 6.0 -1 7 7 12\n", "1 1 0 0 0 0 0 0 1 5 5 -1\n", "1 1 0 0 0 0 0 0 1 nan -NaN -1\n"]
)  # the last two look like poses
def test_images_without_a_line_of_points_are_all_read(names: tuple[str, ...], points: str, tmp_path: Path) -> None:
    root = tiny.colmap_txt(tmp_path)
    for old, new in zip(NAMES, names, strict=True):
        (root / "images" / old).rename(root / "images" / new)
    (root / "sparse/0/images.txt").write_text(tiny.images_txt(names, points))
    tiny.require_poses(colmap.read(root))


def test_a_text_model_that_has_fewer_images_than_its_header_says_is_told(tmp_path: Path, caplog) -> None:
    root = tiny.colmap_txt(tmp_path)
    (root / "sparse/0/points3D.txt").unlink()
    (root / "sparse/0/images.txt").write_text(tiny.images_txt(NAMES[:2], "", "# Number of images: 3\n"))
    assert len(colmap.read(root).frames) == 2
    (root / "sparse/0/points3D.txt").write_text("# Number of points: 9, mean track length: 2\n1 0 0 3 0 0 0 0.5 1 0\n")
    assert len(colmap.read(root).points.means) == 1
    assert "images.txt: its header says 3, and 2 are there" in caplog.text
    assert "points3D.txt: its header says 9, and 1 are there" in caplog.text


# ---- lenses: units, and COLMAP's camera models
HALVES = {"cx": 0.5, "cy": 0.5}


@pytest.mark.parametrize(
    "lens",
    [{"fl_x": 0.9, "fl_y": 1.2, **HALVES}, {"fl_x": 0.9, "fl_y": 1.2}, {"fl_x": 700.0, **HALVES}, {"fl_x": 50.0}],
)
def test_a_lens_in_units_of_the_image_is_refused(lens: dict[str, float], tmp_path: Path) -> None:
    root = tiny.nerfstudio(tmp_path)
    tiny.write_photos(root / "images", (800, 600))
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        tiny.edit(root / "transforms.json", lambda value, key=key: value.pop(key))
    tiny.edit(root / "transforms.json", lambda value: value.update(lens))
    with pytest.raises(DataError, match=r"frames\[0\]: has focal lengths .* all must be pixels: multiply"):
        nerfstudio.read(root)
    scale = {"fl_x": 800, "fl_y": 600, "cx": 800, "cy": 600}
    pixels = {key: value * scale[key] if value < 100 else value for key, value in lens.items()}
    tiny.edit(root / "transforms.json", lambda value: value.update(pixels))
    assert len(nerfstudio.read(root).frames) == 3  # the remedy


SUPPORTED = {  # the parameters, and k1 of a fisheye
    "FOV": ((20, 20, 8, 6, 0), None), "SIMPLE_DIVISION": ((20, 8, 6, 0), None), "DIVISION": ((20, 20, 8, 6, 0), None),
    "EUCM": ((20, 20, 8, 6, 0, 1), None), "SIMPLE_FISHEYE": ((20, 8, 6), 0.0), "FISHEYE": ((20, 20, 8, 6), 0.0),
    "OPENCV_FISHEYE": ((20, 20, 8, 6, 0.1, 0, 0, 0), 0.1), "THIN_PRISM_FISHEYE": ((20, 20, 8, 6, 0.1, *[0] * 7), 0.1),
    "RAD_TAN_THIN_PRISM_FISHEYE": ((20, 20, 8, 6, 0.1, *[0] * 11), 0.1),
}  # fmt: skip


def with_model(root: Path, model: str, parameters: tuple[float, ...], layout: str) -> Path:
    pycolmap = pytest.importorskip("pycolmap")
    tiny.colmap_txt(root)
    camera = pycolmap.Camera(model=model, width=16, height=12, params=parameters)
    model_of_one = pycolmap.Reconstruction()
    camera.camera_id = 1
    model_of_one.add_camera(camera)
    (root / "written").mkdir()
    (model_of_one.write_text if layout == "txt" else model_of_one.write_binary)(str(root / "written"))
    if layout == "txt":
        (root / "written/cameras.txt").replace(root / "sparse/0/cameras.txt")
        return root
    return root / "written"


@pytest.mark.parametrize("model", SUPPORTED)
def test_models_with_coefficients_of_zero_are_those_that_opencv_has(model: str, tmp_path: Path) -> None:
    parameters, k1 = SUPPORTED[model]
    frame = colmap.read(with_model(tmp_path, model, parameters, "txt")).frames[0]
    assert (frame.lens.fx, frame.lens.cx, frame.lens.fisheye) == (20, 8, k1 is not None)
    import pycolmap

    camera = pycolmap.Camera(model=model, width=16, height=12, params=parameters)
    ray = np.array([[0.3, -0.2, 1.0]])
    theirs = camera.img_from_cam(ray)[0]
    angle = math.atan2(math.hypot(0.3, 0.2), 1.0)
    along = math.tan(angle) if k1 is None else angle * (1 + k1 * angle**2)
    ours = np.array([8, 6]) + 20 * along * np.array([0.3, -0.2]) / math.hypot(0.3, 0.2)
    np.testing.assert_allclose(theirs, ours, atol=1e-6)


@pytest.mark.parametrize("layout", ["bin", "txt"])
@pytest.mark.parametrize(
    ("model", "parameters", "command"),
    [
        ("FOV", (20, 20, 8, 6, 0.5), "omega = 0.5; of the camera model FOV it must be 0.*colmap image_undistorter"),
        ("THIN_PRISM_FISHEYE", (20, 20, 8, 6, *[0] * 7, 0.1), "sy1 = 0.1; .*THIN_PRISM_FISHEYE.*colmap image_undistorter"),
        ("EQUIRECTANGULAR", (16, 12), "EQUIRECTANGULAR, .*ns-process-data images --camera-type equirectangular"),
    ],
)  # fmt: skip
def test_other_models_are_refused_by_name(model, parameters, command, layout, tmp_path):
    from clear_strategies.data.readers.colmap_model import read_cameras

    root = with_model(tmp_path, model, parameters, layout)
    with pytest.raises(DataError, match=command):
        read_cameras(root / "cameras.bin" if layout == "bin" else root / "sparse/0/cameras.txt", {1})


# ---- too little to train on
@pytest.mark.parametrize(("others", "warned"), [(1, False), (3, True)])
def test_where_few_photos_have_a_pose_a_note_says_so(others: int, warned: bool, tmp_path: Path) -> None:
    root = tiny.colmap_txt(tmp_path)
    for i in range(others):
        Image.new("RGB", (16, 12)).save(root / f"images/z{i}.png")
    data = scene.DataSettings(reader=lambda: colmap.read(root))
    capture, _ = scene.read(data, Bicubic())
    assert (capture.notes.get(scene.FEW_PLACED, "").startswith("3 of 6 photos (50%) have a pose")) == warned


@pytest.mark.parametrize("jitter", [0.0, 2e-7])
def test_photos_from_one_place_are_refused_before_they_are_decoded_unless_points_are_given(jitter, tmp_path):
    root = tiny.demo_on_disk(tmp_path, scale=jitter)
    for file in (root / "images").iterdir():
        file.write_bytes(file.read_bytes()[:-60])

    def aside(value: dict[str, Any]) -> None:
        for frame in value["frames"]:
            frame["transform_matrix"][0][3] += 1

    tiny.edit(root / "transforms.json", aside)
    with pytest.raises(DataError, match="no parallax: the photos are all from one place"):
        prepare(nerfstudio.read(root), ViewSettings(), Bicubic(), CloudSettings())
    write_points(root / "points.ply", torch.ones(1, 3), torch.zeros(1, 3))
    given = CloudSettings(init="ply", path=str(root / "points.ply"))
    with pytest.raises(DataError, match="cannot be decoded"):
        prepare(nerfstudio.read(root), ViewSettings(), Bicubic(), given)


@pytest.mark.slow
def test_photos_turned_on_the_spot_are_refused_before_poses_are_made_up(tmp_path: Path) -> None:
    """Without this check COLMAP places all of them along a line that never was, by a wrong focal length."""
    pytest.importorskip("pycolmap")
    base = demo.read(width=240, height=180, views=5, train=2).frames[2].camera
    center = base.center.double()
    for i, angle in enumerate(map(math.radians, (-12, -7, -2, 4))):
        turn = torch.tensor(
            [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
        ).double()
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = turn @ base.world_to_camera.double()[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ center
        write_png(tmp_path / f"photos/{i}.png", demo.render(replace(base, world_to_camera=pose)))
    with pytest.raises(DataError, match=r"no parallax: .*: take a step to the side"):
        photos.read(tmp_path / "photos", tmp_path / "cache", precise=False)


# ---- docs/how-to/captures.md: each tool of its table, by small files as it writes them, is read as the table says
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


def vggt(root: Path) -> None:
    """A model in sparse/ itself, with a pinhole for each photo, and a cloud beside it."""
    folder = tiny.colmap_bin(root) / "sparse"
    for file in (folder / "0").iterdir():
        file.rename(folder / file.name)
    (folder / "0").rmdir()
    count, pinhole = len(NAMES), tiny.MODEL_NUMBERS["PINHOLE"]
    cameras = [struct.pack("<iiQQ4d", i + 1, pinhole, WIDTH, HEIGHT, FOCAL, FOCAL, 8, 6) for i in range(count)]
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", count) + b"".join(cameras))
    images = (folder / "images.bin").read_bytes()
    for i, name in enumerate(NAMES):
        images = images.replace(struct.pack("<i", 1) + name.encode(), struct.pack("<i", i + 1) + name.encode())
    (folder / "images.bin").write_bytes(images)
    write_points(folder / "points.ply", torch.ones(2, 3), torch.zeros(2, 3))


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
    "BlenderNeRF": blender_nerf, "LLFF": tiny.llff, "VGGT": vggt,
}  # fmt: skip
POINTS = ("COLMAP 3", "COLMAP 4", "RealityCapture", "nerfstudio", "BlenderNeRF", "LLFF", "VGGT")


def test_the_table_has_every_tool(tmp_path: Path) -> None:
    assert set(ROWS) == {*WRITE, "plain photos", "videos"}
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (16, 12)).save(tmp_path / "photos/a.jpg")
    assert detect(tmp_path / "photos") == ROWS["plain photos"] == "photos"


@pytest.mark.parametrize("tool", WRITE)
def test_a_tools_files_are_read_as_the_table_says(tool: str, tmp_path: Path) -> None:
    root = tmp_path / "capture"
    WRITE[tool](root)
    assert detect(root) == ROWS[tool]
    capture = tiny.READERS[ROWS[tool]](root)
    tiny.require_poses(capture)
    assert (capture.points is not None and len(capture.points.means) == 2) == (tool in POINTS)
