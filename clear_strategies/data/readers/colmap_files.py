"""The records of COLMAP's cameras, images and points3D files, binary (.bin) or text (.txt); `colmap_model` checks the values."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes

# name -> COLMAP's number for the model, and how many parameters it has.
_MODELS: Final = {
    "SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "RADIAL": (3, 5), "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8), "FULL_OPENCV": (6, 12), "SIMPLE_RADIAL_FISHEYE": (8, 4), "RADIAL_FISHEYE": (9, 5),
}  # fmt: skip
_MODEL_OF_NUMBER: Final = {number: name for name, (number, _) in _MODELS.items()}
_LONGEST_NAME: Final = 4096
_NUMBER: Final = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
_WHOLE: Final = re.compile(r"-?[0-9]{1,18}")


class Camera(NamedTuple):
    """A camera by COLMAP's name of its model; `where` in the file it is, for messages."""

    where: str
    id: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class Image(NamedTuple):
    """A registered image: world-to-camera as (w, x, y, z) and translation, its camera's id, and its file name."""

    id: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


Point = tuple[int, Sequence[float], Sequence[int], np.ndarray]
"""Id, position, 8-bit colour, and the ids of the images that observe it; a plain tuple, because there may be millions."""


def damaged(path: Path, where: str, problem: str) -> DataError:
    """The error for a file that is not as COLMAP writes it."""
    return DataError(path, where, problem, "export the model again")


def cameras(path: Path) -> Iterator[Camera]:
    return _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)


def images(path: Path) -> Iterator[Image]:
    return _binary_images(path) if path.suffix == ".bin" else _text_images(path)


def points(path: Path) -> Iterator[Point]:
    return _binary_points(path) if path.suffix == ".bin" else _text_points(path)


def _parameters_of(path: Path, model: str) -> int:
    if model not in _MODELS:
        remedy = "undistort with `colmap image_undistorter` first"
        raise DataError(path, "camera model", f"{model[:40]} is not supported", remedy)
    return _MODELS[model][1]


class _Bytes:
    """A file's bytes, read from front to back. Each count is compared with the bytes left before anything is allocated."""

    def __init__(self, path: Path) -> None:
        self.data, self.path, self.at = read_bytes(path), path, 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, layout: str, field: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        if size > self.left:
            raise damaged(self.path, field, f"needs {size} bytes, {self.left} are left: truncated")
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += size
        return values

    def count(self, field: str, record: int) -> int:
        """A 64-bit count of records of at least `record` bytes each."""
        (n,) = self.take("<Q", field)
        if n * record > self.left:
            problem = f"is {n}, of {record} bytes or more each, but {self.left} bytes are left"
            raise damaged(self.path, field, problem)
        return int(n)

    def text(self, field: str) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise damaged(self.path, field, "is no text that ends")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise damaged(self.path, field, "is no UTF-8 text") from error

    def finish(self) -> None:
        if self.left:
            raise damaged(self.path, "end", f"{self.left} bytes are left over")


def _binary_cameras(path: Path) -> Iterator[Camera]:
    file = _Bytes(path)
    for i in range(file.count("number of cameras", 24 + 3 * 8)):
        number, kind, width, height = file.take("<iiQQ", f"camera {i}")
        model = _MODEL_OF_NUMBER.get(kind, f"number {kind}")
        parameters = file.take(f"<{_parameters_of(path, model)}d", f"parameters of camera {i}")
        yield Camera(f"camera {number}", number, model, width, height, parameters)
    file.finish()


def _binary_images(path: Path) -> Iterator[Image]:
    file = _Bytes(path)
    for i in range(file.count("number of images", 4 + 7 * 8 + 4 + 1 + 8)):
        number, *pose, camera = file.take("<i7di", f"image {i}")
        name = file.text(f"name of image {i}")
        seen = file.count(f"2D points of {name!r}", 24)
        file.at += 24 * seen
        yield Image(number, tuple(pose[:4]), tuple(pose[4:]), camera, name)
    file.finish()


def _binary_points(path: Path) -> Iterator[Point]:
    file = _Bytes(path)
    for i in range(file.count("number of points", 8 + 24 + 3 + 8 + 8)):
        record = file.take("<Q3d3Bd", f"point {i}")  # id, position, colour, error
        length = file.count(f"track of point {i}", 8)
        track = np.frombuffer(file.data, "<i4", 2 * length, file.at)[::2]
        file.at += 8 * length
        yield record[0], record[1:4], record[4:7], track
    file.finish()


def _text_cameras(path: Path) -> Iterator[Camera]:
    for line, cells in _rows(path):
        where = f"line {line}"
        if len(cells) < 4:
            raise damaged(path, where, f"has {len(cells)} of at least 5 columns")
        width, height = _integer(path, line, cells[2]), _integer(path, line, cells[3])
        expected = _parameters_of(path, cells[1])
        if len(cells) != 4 + expected:
            raise damaged(path, where, f"has {len(cells) - 4} parameters, {cells[1]} has {expected}")
        parameters = tuple(_number(path, line, cell) for cell in cells[4:])
        yield Camera(where, _integer(path, line, cells[0]), cells[1], width, height, parameters)


def _text_images(path: Path) -> Iterator[Image]:
    """Two lines per image: its pose, then its 2D points, which are not used and may be none."""
    lines = iter(_lines(path))
    for line, text in lines:
        if not text.strip() or text.startswith("#"):
            continue
        cells = text.split(maxsplit=9)
        if len(cells) != 10:
            raise damaged(path, f"line {line}", f"has {len(cells)} of 10 columns")
        number, camera = _integer(path, line, cells[0]), _integer(path, line, cells[8])
        pose = tuple(_number(path, line, cell) for cell in cells[1:8])
        yield Image(number, pose[:4], pose[4:], camera, cells[9].strip())
        second = next(lines, None)
        if second is None or len(second[1].split()) % 3 or second[1].startswith("#"):
            problem = "is no line of 2D points (X Y POINT3D_ID, or empty) for the image above it"
            raise damaged(path, f"line {line + 1}", problem)


def _text_points(path: Path) -> Iterator[Point]:
    for line, cells in _rows(path):
        if len(cells) < 8 or len(cells) % 2:
            raise damaged(path, f"line {line}", f"has {len(cells)} columns where 8 and pairs belong")
        position = [_number(path, line, cell) for cell in cells[1:4]]
        color = [_integer(path, line, cell) for cell in cells[4:7]]
        if not all(0 <= c <= 255 for c in color):
            raise DataError(path, f"line {line}", f"has the colour {color}", "colours lie in 0..255")
        track = np.array([_integer(path, line, cell) for cell in cells[8::2]], np.int64)
        yield _integer(path, line, cells[0]), position, color, track


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        text = io.StringIO(read_bytes(path).decode(), newline=None).read()  # with every line break as \n
    except UnicodeDecodeError as error:
        raise damaged(path, "file", "is no UTF-8 text") from error
    if text.startswith("\ufeff"):
        raise DataError(path, "line 1", "starts with a byte-order mark", "save it as UTF-8 without one")
    return list(enumerate(text.split("\n"), start=1))


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    for line, text in _lines(path):
        if text.strip() and not text.startswith("#"):
            yield line, text.split()


def _number(path: Path, line: int, cell: str) -> float:
    if not _NUMBER.fullmatch(cell):
        comma = "; write a decimal point, not a comma" if "," in cell else ""
        raise damaged(path, f"line {line}", f"has {cell[:40]!r} where a finite number belongs{comma}")
    return float(cell)


def _integer(path: Path, line: int, cell: str) -> int:
    if not _WHOLE.fullmatch(cell):
        raise damaged(path, f"line {line}", f"has {cell[:40]!r} where a whole number belongs")
    return int(cell)
