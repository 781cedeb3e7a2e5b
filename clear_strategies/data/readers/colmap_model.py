"""The files of COLMAP's sparse models, binary and text, read strictly.

Every count is compared with the bytes that are left before anything is allocated. Every number must be finite, every id
known, and no byte may be left over.
"""

from __future__ import annotations

import logging
import math
import re
import struct
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.cameras import FARTHEST, Lens
from clear_strategies.errors import DataError
from clear_strategies.files import require_regular
from rasterizers.geometry import rotation_matrix

_log = logging.getLogger(__name__)

# name -> COLMAP's number for the model, and how many parameters it has.
_MODELS: Final = {
    "SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "RADIAL": (3, 5), "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8), "FULL_OPENCV": (6, 12), "SIMPLE_RADIAL_FISHEYE": (8, 4), "RADIAL_FISHEYE": (9, 5),
}  # fmt: skip
_MODEL_OF_ID: Final = {number: name for name, (number, _) in _MODELS.items()}
_WRITE_AGAIN: Final = "export the model again"
_LONGEST_NAME: Final = 4096
_NUMBER: Final = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
_WHOLE: Final = re.compile(r"-?[0-9]{1,18}")


@dataclass(frozen=True, slots=True)
class Image:
    """A registered image: COLMAP's id, world-to-camera as (w, x, y, z) and translation, its camera and file name."""

    id: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Positions, 8-bit colours, and the tracks: point `track[j, 0]` is observed in image `track[j, 1]`."""

    means: np.ndarray
    colors: np.ndarray
    track: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """The content of a sparse model's files, whose `ending` is .bin or .txt."""

    folder: Path
    ending: str
    lenses: dict[int, Lens]
    images: list[Image]
    points: Points


def find_model(root: Path) -> Path:
    """The folder of the sparse model.

    Raises:
        DataError: there is none.
    """
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    for candidate in (root / "sparse" / "0", root / "sparse", root / "colmap" / "sparse" / "0", root):
        if _is_model(candidate):
            others = [p.name for p in sorted(candidate.parent.glob("[1-9]*")) if candidate.name == "0" and _is_model(p)]
            if others:
                _log.warning("%s: model 0 is used; COLMAP's other models (%s) are not.", root, ", ".join(others))
            return candidate
    raise DataError(
        root, "sparse model", "no cameras.bin or cameras.txt in sparse/0, sparse, colmap/sparse/0 or here",
        "run COLMAP first, or use data=photos for photos without poses",
    )  # fmt: skip


def read_model(folder: Path) -> Model:
    """Cameras, images and points of a model folder. If there is any binary file, text files are ignored.

    Raises:
        DataError: a file is missing or not what it should be.
    """
    binary = any((folder / f"{name}.bin").exists() for name in ("cameras", "images", "points3D"))
    ending = ".bin" if binary else ".txt"
    lenses = read_cameras(folder / f"cameras{ending}")
    registered = read_images(folder / f"images{ending}")
    if not registered:
        raise DataError(folder / f"images{ending}", "images", "there is none", "run COLMAP's mapper to its end")
    for image in registered:
        if image.camera not in lenses:
            raise DataError(
                folder / f"images{ending}", image.name, f"has the unknown camera {image.camera}", _WRITE_AGAIN
            )
    file = folder / f"points3D{ending}"
    if not file.exists():
        _log.debug("%s has no %s: the capture has no points.", folder, file.name)
        points = _checked_points(file, set(), [], [], [])
    else:
        points = read_points(file)
        unknown = np.setdiff1d(points.track[:, 1], [image.id for image in registered])
        if len(unknown):
            raise DataError(file, "track", f"names the unknown image {unknown[0]}", _WRITE_AGAIN)
    return Model(folder, ending, lenses, registered, points)


def read_cameras(file: Path) -> dict[int, Lens]:
    """cameras.bin or cameras.txt: the lens of each camera by its id.

    Raises:
        DataError: the file is not what it should be.
    """
    return _cameras_bin(file) if file.suffix == ".bin" else _cameras_txt(file)


def read_images(file: Path) -> list[Image]:
    """images.bin or images.txt.

    Raises:
        DataError: the file is not what it should be.
    """
    return _images_bin(file) if file.suffix == ".bin" else _images_txt(file)


def read_points(file: Path) -> Points:
    """points3D.bin or points3D.txt.

    Raises:
        DataError: the file is not what it should be.
    """
    return _points_bin(file) if file.suffix == ".bin" else _points_txt(file)


def pose_of(image: Image) -> Float[Tensor, "4 4"]:
    """World-to-camera."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrix(torch.tensor([image.quat], dtype=torch.float64))[0]
    pose[:3, 3] = torch.tensor(image.translation, dtype=torch.float64)
    return pose


def _is_model(folder: Path) -> bool:
    return any((folder / f"{name}{ending}").is_file() for name in ("cameras", "images") for ending in (".bin", ".txt"))


class _Bytes:
    """A file's bytes, read from front to back; reading past the end is an error."""

    def __init__(self, path: Path) -> None:
        require_regular(path)
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise DataError(path, "file", f"cannot be read ({error.strerror})", "check the path") from error
        self.path, self.at = path, 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, layout: str, field: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        if size > self.left:
            raise DataError(self.path, field, f"needs {size} bytes, {self.left} are left: truncated", _WRITE_AGAIN)
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += size
        return values

    def count(self, field: str, record: int) -> int:
        """A 64-bit count of records of at least `record` bytes each."""
        (n,) = self.take("<Q", field)
        if n * record > self.left:
            raise DataError(
                self.path,
                field,
                f"is {n}, of {record} bytes or more each, but {self.left} bytes are left",
                _WRITE_AGAIN,
            )
        return int(n)

    def skip(self, size: int) -> None:
        self.at += size

    def text(self, field: str) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise DataError(self.path, field, "is no text that ends", _WRITE_AGAIN)
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise DataError(self.path, field, "is no UTF-8 text", _WRITE_AGAIN) from error

    def finish(self) -> None:
        if self.left:
            raise DataError(self.path, "end", f"{self.left} bytes are left over", _WRITE_AGAIN)


def _cameras_bin(path: Path) -> dict[int, Lens]:
    file = _Bytes(path)
    lenses: dict[int, Lens] = {}
    for i in range(file.count("number of cameras", 24 + 3 * 8)):
        number, kind, width, height = (int(x) for x in file.take("<iiQQ", f"camera {i}"))
        name = _MODEL_OF_ID.get(kind, f"number {kind}")
        parameters = file.take(f"<{_parameters(path, name)}d", f"parameters of camera {i}")
        _put(path, lenses, number, _lens(path, f"camera {number}", name, width, height, parameters))
    file.finish()
    return lenses


def _images_bin(path: Path) -> list[Image]:
    file = _Bytes(path)
    found: dict[int, Image] = {}
    for i in range(file.count("number of images", 4 + 7 * 8 + 4 + 1 + 8)):
        field = f"image {i}"
        number, *pose = file.take("<i7d", field)
        (camera,) = file.take("<i", field)
        name = file.text(f"name of image {i}")
        file.skip(24 * file.count(f"2D points of {name!r}", 24))
        _put(path, found, int(number), _image(path, int(number), tuple(pose), int(camera), name))
    file.finish()
    return list(found.values())


def _points_bin(path: Path) -> Points:
    file = _Bytes(path)
    n = file.count("number of points", 8 + 24 + 3 + 8 + 8)
    means, colors, track, ids = [], [], [], set()
    for i in range(n):
        number, x, y, z, r, g, b, _ = file.take("<Q3d3Bd", f"point {i}")
        means.append((x, y, z))
        colors.append((r, g, b))
        ids.add(number)
        length = file.count(f"track of point {i}", 8)
        track.append(np.frombuffer(file.data, "<i4", 2 * length, file.at)[::2])
        file.skip(8 * length)
    file.finish()
    return _checked_points(path, ids, means, colors, track)


def _cameras_txt(path: Path) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    for line, cells in _lines(path):
        if len(cells) < 4:
            raise DataError(path, f"line {line}", f"has {len(cells)} of at least 5 columns", _WRITE_AGAIN)
        width, height = _integer(path, line, cells[2]), _integer(path, line, cells[3])
        expected = _parameters(path, cells[1])
        if len(cells) != 4 + expected:
            raise DataError(
                path, f"line {line}", f"has {len(cells) - 4} parameters, {cells[1]} has {expected}", _WRITE_AGAIN
            )
        parameters = tuple(_number(path, line, c) for c in cells[4:])
        lens = _lens(path, f"line {line}", cells[1], width, height, parameters)
        _put(path, lenses, _integer(path, line, cells[0]), lens)
    return lenses


def _images_txt(path: Path) -> list[Image]:
    """Two lines per image: its pose, then its 2D points, which are not used and may be none."""
    found: dict[int, Image] = {}
    lines = iter(_raw_lines(path))
    for line, text in lines:
        if not text.strip() or text.startswith("#"):
            continue
        cells = text.split(maxsplit=9)
        if len(cells) != 10:
            raise DataError(path, f"line {line}", f"has {len(cells)} of 10 columns", _WRITE_AGAIN)
        number, camera = _integer(path, line, cells[0]), _integer(path, line, cells[8])
        pose = tuple(_number(path, line, c) for c in cells[1:8])
        _put(path, found, number, _image(path, number, pose, camera, cells[9].strip()))
        second = next(lines, None)
        if second is None or len(second[1].split()) % 3 or second[1].startswith("#"):
            raise DataError(
                path, f"line {line + 1}", "is no line of 2D points (X Y POINT3D_ID, or empty) for the image above it",
                _WRITE_AGAIN,
            )  # fmt: skip
    return list(found.values())


def _points_txt(path: Path) -> Points:
    means, colors, track, ids = list[list[float]](), list[list[int]](), [], set()
    for line, cells in _lines(path):
        if len(cells) < 8 or len(cells) % 2:
            raise DataError(path, f"line {line}", f"has {len(cells)} columns where 8 and pairs belong", _WRITE_AGAIN)
        means.append([_number(path, line, c) for c in cells[1:4]])
        rgb = [_integer(path, line, c) for c in cells[4:7]]
        if not all(0 <= c <= 255 for c in rgb):
            raise DataError(path, f"line {line}", f"has the colour {rgb}", "colours lie in 0..255")
        colors.append(rgb)
        ids.add(_integer(path, line, cells[0]))
        track.append(np.array([_integer(path, line, c) for c in cells[8::2]], np.int64))
    return _checked_points(path, ids, means, colors, track)


def _checked_points(
    path: Path,
    ids: Set[int],
    means: Sequence[Sequence[float]],
    colors: Sequence[Sequence[int]],
    track: Sequence[np.ndarray],
) -> Points:
    """`track`: of each point, the ids of the images that observe it."""
    if len(ids) != len(means):
        raise DataError(path, "point id", "occurs twice", _WRITE_AGAIN)
    if not means:
        return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 2), np.int64))
    where = np.array(means)
    near = np.abs(where) < FARTHEST
    if not near.all():
        bad = int(np.argwhere(~near)[0, 0])
        raise DataError(path, f"point {bad}", "is not finite", "remove the point")
    point = np.repeat(np.arange(len(means)), [len(images) for images in track])
    observed = np.stack((point, np.concatenate(track).astype(np.int64)), axis=1)
    return Points(where, np.array(colors, np.uint8), observed)


def _parameters(path: Path, model: str) -> int:
    if model not in _MODELS:
        raise DataError(
            path, "camera model", f"{model[:40]} is not supported", "undistort with `colmap image_undistorter` first"
        )
    return _MODELS[model][1]


def _lens(path: Path, where: str, model: str, width: int, height: int, p: tuple[float, ...]) -> Lens:
    fisheye = model.endswith("_FISHEYE")
    if model not in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"):
        f, cx, cy, *radial = p  # one focal length, and k1, k2 if the model has them; the other terms are 0
        distortion = (*radial, *[0.0] * (4 - len(radial))) if radial else ()
        return Lens(width, height, f, f, cx, cy, distortion, fisheye).check(path, where)
    fx, fy, cx, cy, *rest = p
    return Lens(width, height, fx, fy, cx, cy, tuple(rest), fisheye).check(path, where)


def _image(path: Path, number: int, pose: tuple[float, ...], camera: int, name: str) -> Image:
    if not all(abs(x) < FARTHEST for x in pose):
        raise DataError(path, name or f"image {number}", "has a pose that is not finite", _WRITE_AGAIN)
    norm = math.hypot(*pose[:4])
    if not 0.5 < norm < 2:
        raise DataError(
            path, name or f"image {number}", f"has a rotation quaternion of length {norm:.3g}", _WRITE_AGAIN
        )
    return Image(number, pose[:4], pose[4:], camera, name)


def _put(path: Path, table: dict[int, Any], number: int, value: Any) -> None:
    if number in table:
        raise DataError(path, f"id {number}", "occurs twice", _WRITE_AGAIN)
    table[number] = value


def _raw_lines(path: Path) -> list[tuple[int, str]]:
    require_regular(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(path, "file", f"cannot be read ({error.strerror})", "check the path") from error
    except UnicodeDecodeError as error:
        raise DataError(path, "file", "is no UTF-8 text", _WRITE_AGAIN) from error
    if text.startswith("\ufeff"):
        raise DataError(path, "line 1", "starts with a byte-order mark", "save it as UTF-8 without one")
    return list(enumerate(text.split("\n"), start=1))


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, text in _raw_lines(path):
        if text.strip() and not text.startswith("#"):
            yield number, text.split()


def _number(path: Path, line: int, cell: str) -> float:
    if not _NUMBER.fullmatch(cell):
        hint = "write a decimal point, not a comma" if "," in cell else _WRITE_AGAIN
        raise DataError(path, f"line {line}", f"has {cell[:40]!r} where a finite number belongs", hint)
    return float(cell)


def _integer(path: Path, line: int, cell: str) -> int:
    if not _WHOLE.fullmatch(cell):
        raise DataError(path, f"line {line}", f"has {cell[:40]!r} where a whole number belongs", _WRITE_AGAIN)
    return int(cell)
