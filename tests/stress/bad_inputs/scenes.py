"""Captures with one defect: COLMAP, Blender and nerfstudio files, and the photos that belong to them."""

import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.helpers import captures as tiny
from tests.helpers.image_files import exif_orientation
from tests.stress.bad_inputs import BadInput

Spoil = Callable[[Path], object]


def case(name: str, good: str, spoil: Spoil, pattern: str) -> BadInput:
    """A sound scene by its name in `GOOD`, after a change to its folder."""

    def give(folder: Path) -> None:
        root = tiny.GOOD[good](folder / "scene")
        spoil(root)
        for frame in tiny.READERS[good](root).frames:
            frame.load()

    return BadInput(good.removesuffix("_txt"), name, give, pattern)


def remove(name: str) -> Spoil:
    return lambda root: (root / name).unlink()


def write(name: str, data: bytes) -> Spoil:
    return lambda root: (root / name).write_bytes(data)


def cut(name: str, size: int) -> Spoil:
    """Keep the first `size` bytes, or all but the last -size."""
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:size])


def append(name: str, data: bytes) -> Spoil:
    return lambda root: (root / name).write_bytes((root / name).read_bytes() + data)


def patch(name: str, at: int, layout: str, *values: float) -> Spoil:
    """Overwrite packed numbers at a byte offset."""

    def spoil(root: Path) -> None:
        data = bytearray((root / name).read_bytes())
        struct.pack_into(layout, data, at, *values)
        (root / name).write_bytes(bytes(data))

    return spoil


def replace(name: str, old: str, new: str) -> Spoil:
    """Replace the first occurrence of a text, which must be there."""

    def spoil(root: Path) -> None:
        text = (root / name).read_text()
        if old not in text:
            raise LookupError(f"{old!r} is not in {name}: the case would spoil nothing")
        (root / name).write_text(text.replace(old, new, 1))

    return spoil


def edit(name: str, change: Callable[[dict[str, Any]], object]) -> Spoil:
    """Change a JSON file's object in place."""
    return lambda root: tiny.edit(root / name, change)


def edit_frame(name: str, **values: object) -> Spoil:
    return edit(name, lambda value: value["frames"][1].update(values))


def save_image(name: str, **options: Any) -> Spoil:
    """Replace a photo by another kind of image."""
    size = options.pop("size", (tiny.WIDTH, tiny.HEIGHT))
    mode = options.pop("mode", "RGB")
    return lambda root: Image.new(mode, size).save(root / name, **options)


def photo_outside(root: Path, absolute: bool = False) -> None:
    outside = (root / "images/a.png").rename(root / "outside.png")
    replace(IMAGES_TXT, "a.png", str(outside) if absolute else "../outside.png")(root)


def link_in_circle(name: str) -> Spoil:
    def spoil(root: Path) -> None:
        (root / name).unlink()
        (root / name).symlink_to(root / name)

    return spoil


def turned(root: Path) -> None:
    photo = Image.new("RGB", (tiny.WIDTH, tiny.HEIGHT))
    photo.save(root / "images/b.png", format="JPEG", exif=exif_orientation(3))


def two_images_of_one_name(root: Path) -> None:
    file = root / "sparse/0/images.bin"
    file.write_bytes(file.read_bytes().replace(b"b.png\0", b"a.png\0"))


def name_without_end(root: Path) -> None:
    cut(IMAGES, NAME_AT)(root)
    append(IMAGES, b"x" * 300)(root)


CAMERAS, IMAGES, POINTS = (f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D"))
CAMERAS_TXT, IMAGES_TXT, POINTS_TXT = (f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D"))
QUATERNION_AT = 8 + 4  # in images.bin: behind the count and the first id
NAME_AT = QUATERNION_AT + 7 * 8 + 4
FAR = [[1.0, 0, 0, 1e17], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
TRAIN, SHARED = "transforms_train.json", "transforms.json"

INPUTS = [
    # COLMAP, binary
    case("no model", "colmap", remove(CAMERAS), r"cameras\.bin: file"),
    case("no photos", "colmap", lambda root: shutil.rmtree(root / "images"), r"images: has none of the folders"),
    case("empty file", "colmap", write(IMAGES, b""), r"images\.bin: number of images: .*truncated"),
    case("cameras truncated", "colmap", cut(CAMERAS, -1), r"cameras\.bin: .*bytes"),
    case("images truncated", "colmap", cut(IMAGES, -9), r"images\.bin: .*left"),
    case("points truncated", "colmap", cut(POINTS, -3), r"points3D\.bin: .*left"),
    case("trailing bytes", "colmap", append(POINTS, b"\0" * 5), r"points3D\.bin: end: 5 bytes"),
    case("count beyond file", "colmap", patch(IMAGES, 0, "<Q", 2**61), r"images\.bin: image 3: needs 64 bytes, 0 are left"),
    case("2D count beyond file", "colmap", patch(IMAGES, NAME_AT + 6, "<Q", 2**60), r"images\.bin: 2D points of 'a"),
    case("track beyond file", "colmap", patch(POINTS, 8 + 8 + 24 + 3 + 8, "<Q", 2**59), r"points3D\.bin: track of"),
    case("zero quaternion", "colmap", patch(IMAGES, QUATERNION_AT, "<4d", 0, 0, 0, 0), r"images\.bin: a\.png: .*leng"),
    # Its length is 2 by hypot, and less by the root of the sum of squares.
    case("quaternion of length 2", "colmap",
         patch(IMAGES, QUATERNION_AT, "<4d", 1.969615506024416, 0, 0.34729635533386066, 0), r"of length 2:"),
    case("NaN pose", "colmap", patch(IMAGES, QUATERNION_AT, "<d", float("nan")), r"images\.bin: a\.png: .*finite"),
    case("NaN point", "colmap", patch(POINTS, 16, "<d", float("nan")), r"points3D\.bin: point 0: .*finite"),
    case("point beyond float32", "colmap", patch(POINTS, 16, "<d", 1e300), r"points3D\.bin: point 0: .*finite"),
    case("unknown camera id", "colmap", patch(IMAGES, NAME_AT - 4, "<i", 9), r"images\.bin: a\.png: .*camera 9"),
    case("duplicate image id", "colmap", patch(IMAGES, 8, "<i", 2), r"images\.bin: id 2: occurs twice"),
    case("duplicate name", "colmap", two_images_of_one_name, r"file name: 'a\.png' belongs to two"),
    case("duplicate point id", "colmap", patch(POINTS, 8, "<Q", 2), r"points3D\.bin: .*occurs twice"),
    case("unknown camera model", "colmap", patch(CAMERAS, 12, "<i", 42), r"camera 1: .* number 42.*image_undistorter"),
    case("no focal length", "colmap", patch(CAMERAS, 32, "<d", 0.0), r"cameras\.bin: camera 1: .*focal"),
    case("size of zero", "colmap", patch(CAMERAS, 16, "<Q", 0), r"cameras\.bin: camera 1: has size 0x12"),
    case("principal point far away", "colmap", patch(CAMERAS, 48, "<d", 1e6), r"cameras\.bin: .*principal point"),
    case("name is no UTF-8", "colmap", patch(IMAGES, NAME_AT, "<B", 0xFF), r"images\.bin: name of image 0: .*UTF-8"),
    case("name without end", "colmap", name_without_end, r"images\.bin: name of image 0: is no text"),
    case("symlink in a circle", "colmap", link_in_circle("images/b.png"), r"images\.bin: .*b\.png"),
    case("photo upside down by EXIF", "colmap", turned, r"b\.png: EXIF orientation: is 3.*auto-orient"),
    # COLMAP, text
    case("txt beside broken bin", "colmap_txt", write(IMAGES, b"\1"), r"images\.bin: number of images"),
    case("txt decimal comma", "colmap_txt", replace(CAMERAS_TXT, "20.0", "20,0"), r"cameras\.txt: line 2: .*comma"),
    case("txt NaN", "colmap_txt", replace(POINTS_TXT, "3.0", "nan"), r"points3D\.txt: point 0: is not finite"),
    case("txt 1e999", "colmap_txt", replace(CAMERAS_TXT, "20.0", "1e999"), r"cameras\.txt: line 2: .*finite"),
    case("txt too few parameters", "colmap_txt", replace(CAMERAS_TXT, " 8 6", " 8"), r"cameras\.txt: line 2: has 3 param"),
    case("txt odd track", "colmap_txt", replace(POINTS_TXT, "0.5 1 0", "0.5 1"), r"points3D\.txt: line 2: has 11 col"),
    case("txt colour 300", "colmap_txt", replace(POINTS_TXT, "255", "300"), r"points3D\.txt: line 2: has the colour"),
    case("txt 5000 digits", "colmap_txt", replace(CAMERAS_TXT, "16", "1" * 5000), r"cameras\.txt: line 2: is not numeric"),
    case("txt id of 20 digits", "colmap_txt", replace(POINTS_TXT, "0.5 1 0", f"0.5 {10**20} 0"), r"line 2: .*64 bits"),
    case("txt absolute path", "colmap_txt", lambda root: photo_outside(root, absolute=True),
         r"images\.txt: file name: '/.*outside\.png' leads out"),
    case("txt path traversal", "colmap_txt", photo_outside, r"images\.txt: file name: '\.\./outside\.png' leads out"),
    # Blender
    case("JSON absent", "blender", remove(TRAIN), r"transforms_train\.json: file"),
    case("no JSON", "blender", write(TRAIN, b"{'a': 1}"), r"transforms_train\.json: json: is not valid"),
    case("JSON list", "blender", write(TRAIN, b"[]"), r"transforms_train\.json: json: is a list"),
    case("deep JSON", "blender", write(TRAIN, b"[" * 100_000), r"transforms_train\.json: json: .*deep"),
    case("no frames", "blender", edit(TRAIN, lambda v: v.update(frames=[])), r"transforms_train\.json: frames: there is none"),
    case("no angle", "blender", edit(TRAIN, lambda v: v.pop("camera_angle_x")), r"fl_x: is missing.*camera_angle_x"),
    case("angle beyond pi", "blender", edit(TRAIN, lambda v: v.update(camera_angle_x=4)), r"camera_angle_x: is 4"),
    case("two frames of one file", "blender", edit_frame(TRAIN, file_path="./train/a"), r"'a' belongs to two"),
    case("frame without image", "blender", edit_frame(TRAIN, file_path="./train/x"), r"train\.json: photos: 1 of 2 .* x: "),
    case("path with a surrogate", "blender", edit_frame(TRAIN, file_path="\ud800"), r"train\.json: json: is not valid"),
    case("path of 5000 letters", "blender", edit_frame(TRAIN, file_path="x" * 5000), r"photos: 1 of 2 .* x{80}: "),
    # nerfstudio
    case("NaN constant", "nerfstudio", replace(SHARED, '"fl_x": 20.0', '"fl_x": NaN'), r"json: is not valid \(JSON is malformed"),
    case("number of 100 digits", "nerfstudio", edit(SHARED, lambda v: v.update(fl_x=10**100)), r"fl_x: must be"),
    case("text for a number", "nerfstudio", edit(SHARED, lambda v: v.update(cx="8")), r"frames\[0\]\.cx: must be"),
    case("no intrinsics", "nerfstudio", edit(SHARED, lambda v: v.pop("fl_x")), r"frames\[0\]\.fl_x: is missing"),
    case("k4 of a perspective camera", "nerfstudio", edit(SHARED, lambda v: v.update(k4=0.1)), r"frames\[0\]: has k4 = 0\.1"),
    case("lens that folds", "nerfstudio", edit(SHARED, lambda v: v.update(k1=-40.0)), r"a\.png: distortion: .*removed"),
    case("matrix 2x4", "nerfstudio", edit_frame(SHARED, transform_matrix=[[1, 0, 0, 0], [0, 1, 0, 0]]),
         r"frames\[1\]\.transform_matrix: is no 3x4"),
    case("matrix farther than float32 resolves", "nerfstudio", edit_frame(SHARED, transform_matrix=FAR),
         r"frames\[1\]\.transform_matrix: is no 3x4"),
    case("matrix missing", "nerfstudio", edit(SHARED, lambda v: v["frames"][1].pop("transform_matrix")),
         r"frames\[1\]\.transform_matrix: is no 3x4"),
    case("matrix mirrors", "nerfstudio", edit_frame(SHARED, transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()),
         r"frames\[1\]\.transform_matrix: holds no rotation"),
    case("matrix last row", "nerfstudio", edit_frame(SHARED, transform_matrix=np.diag([1.0, 1, 1, 2]).tolist()),
         r"frames\[1\]\.transform_matrix: has the last row"),
    case("file_path missing", "nerfstudio", edit_frame(SHARED, file_path=None), r"frames\[1\]\.file_path: must be"),
    case("w and h of another shape", "nerfstudio", edit(SHARED, lambda v: v.update(w=12, h=16)), r"a\.png: size"),
    case("split lists overlap", "nerfstudio",
         edit(SHARED, lambda v: v.update(train_filenames=["images/a.png"], test_filenames=["images/a.png"])),
         r"test_filenames: 'images/a\.png' is for training"),
    case("PLY absent", "nerfstudio", edit(SHARED, lambda v: v.update(ply_file_path="p.ply")), r"p\.ply: file"),
]  # fmt: skip
