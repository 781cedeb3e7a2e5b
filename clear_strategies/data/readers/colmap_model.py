"""COLMAP's sparse models, binary (.bin) or text (.txt), read strictly: every number must be finite and every id known.

pycolmap is no substitute: it reads a points3D.bin that is cut in half without an error.
"""

from __future__ import annotations

import io
import json
import logging
import math
import re
import struct
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from clear_strategies.data.capture import SfmPoints
from clear_strategies.data.file_names import named
from clear_strategies.data.lenses import CAMERA_MODELS, FARTHEST, Lens, lens_of, terms_of
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes
from rasterizers.geometry import rotation_matrix

_log = logging.getLogger(__name__)

_LONGEST_NAME: Final = 4096
_RECORD_COUNT: Final = re.compile(r"^# Number of \w+: (\d+)", re.MULTILINE)  # in a text file's header
_NUMERIC: Final = re.compile(r"(?:[-+.0-9eE\s]+|nan|inf)*+", re.IGNORECASE)  # a line of numbers

_COUNT, _CAMERA, _IMAGE = map(struct.Struct, ("<Q", "<iiQQ", "<i7di"))
_POINT: Final = np.dtype(
    [("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_OBSERVATION: Final = np.dtype([("image", "<i4"), ("feature", "<i4")])  # `length` of them follow a point: its track

_T = TypeVar("_T")
_Number = TypeVar("_Number", int, float)


class Image(NamedTuple):
    """A registered image: world-to-camera as (w, x, y, z) and translation, its camera's id, and its file name."""

    id: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str

    @property
    def pose(self) -> Float[Tensor, "4 4"]:
        """World-to-camera."""
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation_matrix(torch.tensor([self.quat], dtype=torch.float64))[0]
        pose[:3, 3] = torch.tensor(self.translation, dtype=torch.float64)
        return pose


_Points = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Ids [N], positions [N, 3], 8-bit colours [N, 3], lengths of the tracks [N], and the ids of their images, track after track; no
objects of Python, because there may be millions of points.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """The content of a sparse model's files; `listing` is the file of the images, .bin or .txt."""

    folder: Path
    listing: Path
    lenses: dict[int, Lens]
    images: list[Image]
    points: SfmPoints


def model_folders(root: Path) -> Iterator[Path]:
    """Yield the folders that may contain a scene's model; COLMAP's mapper writes numbered models to `sparse`."""
    for sparse in (named(root, "sparse"), root / "colmap" / "sparse"):
        yield from sorted(sparse.glob("[0-9]*"), key=lambda folder: (len(folder.name), folder.name))
        yield sparse
    yield root


def is_model(folder: Path) -> bool:
    return any(file.is_file() for ending in (".bin", ".txt") for file in _files(folder, ending)[:2])


def _files(folder: Path, ending: str | None = None) -> list[Path]:
    """The files of cameras, images and points, also with RealityCapture's capital letters; .txt if there is no .bin."""
    if ending is None:
        ending = ".bin" if any(file.exists() for file in _files(folder, ".bin")) else ".txt"
    return [named(folder, f"{name}{ending}") for name in ("cameras", "images", "points3D")]


def find_model(root: Path) -> Path:
    """Find the folder of the sparse model; of several in one folder, that with most photos. A warning names it unless it is the
    only one, and in sparse/0 or without a number.

    Raises:
        DataError: there is none, or one of several cannot be read.
    """
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    models = list(filter(is_model, model_folders(root)))
    if not models:
        raise DataError(
            root, "sparse model", "no cameras.bin or cameras.txt in sparse/0, sparse/1 …, sparse, colmap/sparse or here",
            "run COLMAP first, or use data=photos for photos without poses",
        )  # fmt: skip
    beside = [model for model in models if model.parent == models[0].parent]
    if len(beside) == 1:
        if models[0] != root and models[0].name[0] in "123456789":
            _log.warning("%s: there is no model in 0, and the one in %s is used.", models[0].parent, models[0].name)
        return models[0]
    photos = {model: len(read_images(_files(model)[1])) for model in beside}
    largest = max(beside, key=lambda model: photos[model])
    others = ", ".join(f"{model.name} with {photos[model]}" for model in beside if model != largest)
    _log.warning(
        "%s: COLMAP left %d models. The largest, %s with %d photos, is used; the others are not: %s.",
        root, len(beside), largest.name, photos[largest], others,
    )  # fmt: skip
    return largest


def read_model(folder: Path) -> Model:
    """Read a model folder: the images, the cameras that they use, and the points. Entries of tracks that refer to images that are
    not listed, as after photos were removed, are left out with a warning.

    Raises:
        DataError: a file is missing or invalid.
    """
    cameras, listing, points3d = _files(folder)
    images = read_images(listing)
    if not images:
        raise DataError(listing, "images", "there is none", "run COLMAP's mapper to its end")
    lenses = read_cameras(cameras, {image.camera for image in images})
    for image in images:
        if image.camera not in lenses:
            raise _damaged(listing, image.name, f"has the unknown camera {image.camera}")
    points = read_points(points3d)
    listed = torch.isin(points.track_image, torch.tensor([image.id for image in images]))
    if not listed.all():
        message = "%s: %s of %s entries of the tracks name images that %s does not list, such as %d, and are left out."
        unlisted = points.track_image[~listed]
        _log.warning(message, points3d, f"{len(unlisted):,}", f"{len(listed):,}", listing.name, unlisted[0])
        points = replace(points, track_point=points.track_point[listed], track_image=points.track_image[listed])
    return Model(folder, listing, lenses, images, points)


def read_cameras(path: Path, used: Set[int]) -> dict[int, Lens]:
    """Read the lenses of the cameras in `used`, by id; others are not checked. Errors as of `read_model`."""
    return _by_id(path, _binary_cameras(path, used) if path.suffix == ".bin" else _text_cameras(path, used))


def read_images(path: Path) -> list[Image]:
    """Read the registered images, in the file's order; errors as of `read_model`."""
    records = _binary_images(path) if path.suffix == ".bin" else _text_images(path)
    images = _by_id(path, ((image.id, image) for image in records))
    for image in images.values():
        where = image.name or f"image {image.id}"
        if not all(abs(x) < FARTHEST for x in (*image.quat, *image.translation)):
            raise _damaged(path, where, "has a pose that is not finite")
        norm = math.hypot(*image.quat)
        if not 0.5 < norm < 2:
            raise _damaged(path, where, f"has a rotation quaternion of length {norm:.3g}")
    return list(images.values())


def read_points(path: Path) -> SfmPoints:
    """Read the points with their tracks; none if the file does not exist."""
    if not path.exists():
        return SfmPoints.without_tracks(torch.zeros(0, 3), torch.zeros(0, 3), "")
    ids, means, colors, lengths, images = (_binary_points if path.suffix == ".bin" else _text_points)(path)
    if len(np.unique(ids)) != len(ids):
        raise _damaged(path, "point id", "occurs twice")
    near = np.abs(means) < FARTHEST
    if not near.all():
        raise DataError(path, f"point {np.argwhere(~near)[0, 0]}", "is not finite", "remove the point")
    positions, levels = (torch.from_numpy(values.astype(np.float32)) for values in (means, colors))
    point, image = np.repeat(np.arange(len(ids)), lengths), images.astype(np.int64)
    return SfmPoints(positions, levels / 255, torch.from_numpy(point), torch.from_numpy(image), "")


def _by_id(path: Path, records: Iterable[tuple[int, _T]]) -> dict[int, _T]:
    found: dict[int, _T] = {}
    for number, record in records:
        if number in found:
            raise _damaged(path, f"id {number}", "occurs twice")
        found[number] = record
    return found


def _lens(path: Path, where: str, model: str, size: tuple[int, int], parameters: Iterable[float]) -> Lens:
    terms = dict(zip(CAMERA_MODELS[model].split(), parameters, strict=True))
    f = terms.pop("f", 0.0)
    pinhole = (terms.pop("fx", f), terms.pop("fy", f), terms.pop("cx"), terms.pop("cy"))
    if model == "EUCM" and terms["alpha"] == 0:
        del terms["beta"]  # of no effect then
    return lens_of(path, where, model, size, pinhole, terms)


def _damaged(path: Path, where: str, problem: str) -> DataError:
    """The error for a file that is not as COLMAP writes it."""
    return DataError(path, where, problem, "export the model again")


class _Bytes:
    """A sequential reader of a file's bytes; a DataError if fewer are left than a field needs."""

    def __init__(self, path: Path) -> None:
        self.data, self.path, self.at = read_bytes(path), path, 0

    def skip(self, size: int, field: str) -> int:
        """Skip `size` bytes, and return their offset."""
        start, left = self.at, len(self.data) - self.at
        if size > left:
            raise _damaged(self.path, field, f"needs {size} bytes, {left} are left: truncated")
        self.at += size
        return start

    def take(self, layout: struct.Struct, field: str) -> tuple[Any, ...]:
        return layout.unpack_from(self.data, self.skip(layout.size, field))

    def count(self, field: str) -> int:
        return int(self.take(_COUNT, field)[0])

    def text(self, field: str) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise _damaged(self.path, field, "is no text that ends")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise _damaged(self.path, field, "is no UTF-8 text") from error

    def finish(self) -> None:
        if left := len(self.data) - self.at:
            raise _damaged(self.path, "end", f"{left} bytes are left over")


def _binary_cameras(path: Path, used: Set[int]) -> Iterator[tuple[int, Lens]]:
    file = _Bytes(path)
    for i in range(file.count("number of cameras")):
        number, kind, width, height = file.take(_CAMERA, f"camera {i}")
        where = f"camera {number}"
        model = dict(enumerate(CAMERA_MODELS)).get(kind, f"number {kind}")
        if number in used or model not in CAMERA_MODELS:  # of an unknown model the length is unknown, too
            terms_of(path, where, model)  # refuses those that are not supported
        layout = struct.Struct(f"<{len(CAMERA_MODELS[model].split())}d")
        parameters = file.take(layout, f"parameters of {where}")
        if number in used:
            yield number, _lens(path, where, model, (width, height), parameters)
    file.finish()


def _binary_images(path: Path) -> Iterator[Image]:
    file = _Bytes(path)
    for i in range(file.count("number of images")):
        number, *pose, camera = file.take(_IMAGE, f"image {i}")
        name = file.text(f"name of image {i}")
        file.skip(24 * file.count(f"2D points of {name!r}"), f"2D points of {name!r}")
        yield Image(number, tuple(pose[:4]), tuple(pose[4:]), camera, name)
    file.finish()


def _binary_points(path: Path) -> _Points:
    file = _Bytes(path)

    def places() -> Iterator[int]:
        for i in range(file.count("number of points")):
            yield (start := file.skip(_POINT.itemsize, f"point {i}"))
            (length,) = _COUNT.unpack_from(file.data, start + _POINT.itemsize - _COUNT.size)
            file.skip(_OBSERVATION.itemsize * length, f"track of point {i}")

    starts = np.fromiter(places(), np.int64)
    file.finish()
    points = _structs(file.data, starts, _POINT)
    lengths = points["length"].astype(np.int64)
    tracks = starts + _POINT.itemsize - _OBSERVATION.itemsize * (lengths.cumsum() - lengths)
    observations = np.repeat(tracks, lengths) + _OBSERVATION.itemsize * np.arange(lengths.sum())
    images = _structs(file.data, observations, _OBSERVATION)["image"]
    return points["id"], points["position"], points["color"], lengths, images


def _structs(data: bytes, places: Int[np.ndarray, " N"], kind: np.dtype[Any]) -> np.ndarray:
    """The structures that begin at these places."""
    if len(places) == 0:
        return np.zeros(0, kind)
    found: np.ndarray = sliding_window_view(np.frombuffer(data, np.uint8), kind.itemsize)[places].view(kind)[:, 0]
    return found


def _text_cameras(path: Path, used: Set[int]) -> Iterator[tuple[int, Lens]]:
    for line, cells in _rows(path):
        (number,) = _numbers(path, line, cells[:1], _whole)
        if number not in used:
            continue
        if len(cells) < 4:
            raise _damaged(path, f"line {line}", f"has {len(cells)} of at least 5 columns")
        width, height = _numbers(path, line, cells[2:4], _whole)
        terms_of(path, f"line {line}", cells[1])  # refuses those that are not supported
        expected = len(CAMERA_MODELS[cells[1]].split())
        if len(cells) != 4 + expected:
            raise _damaged(path, f"line {line}", f"has {len(cells) - 4} parameters, {cells[1]} has {expected}")
        yield number, _lens(path, f"line {line}", cells[1], (width, height), _numbers(path, line, cells[4:], float))


def _text_images(path: Path) -> Iterator[Image]:
    """Parse the pose of each image, and the line of its 2D points after it, which is ignored and may be empty or missing."""
    poses, after_pose = list[tuple[int, str]](), False
    stated, lines = _lines(path)
    for line, text in lines:
        points = after_pose and len(text.split()) % 3 == 0 and _NUMERIC.fullmatch(text) is not None
        if after_pose := bool(text.strip()) and not points:
            poses.append((line, text))
    _warn_if_truncated(path, stated, len(poses))
    for line, text in poses:
        cells = text.split(maxsplit=9)
        if len(cells) != 10:
            raise _damaged(path, f"line {line}", f"has {len(cells)} of 10 columns")
        number, camera = _numbers(path, line, (cells[0], cells[8]), _whole)
        numbers = _numbers(path, line, cells[1:8], float)
        yield Image(number, tuple(numbers[:4]), tuple(numbers[4:]), camera, cells[9].strip())


def _text_points(path: Path) -> _Points:
    ids, lengths, images, positions, colors = array("q"), array("q"), array("q"), array("d"), array("B")
    for line, cells in _rows(path):
        if len(cells) < 8 or len(cells) % 2:
            raise _damaged(path, f"line {line}", f"has {len(cells)} columns where 8 and pairs belong")
        color = _numbers(path, line, cells[4:7], _whole)
        if not all(0 <= c <= 255 for c in color):
            raise DataError(path, f"line {line}", f"has the colour {color}", "colours lie in 0..255")
        colors.extend(color)
        positions.extend(_numbers(path, line, cells[1:4], float))
        ids.extend(_numbers(path, line, cells[:1], _whole))
        images.extend(_numbers(path, line, cells[8::2], _whole))
        lengths.append(len(cells) // 2 - 4)
    by_point = np.reshape(positions, (-1, 3)), np.reshape(colors, (-1, 3))
    return np.asarray(ids), *by_point, np.asarray(lengths), np.asarray(images)


def _lines(path: Path) -> tuple[int, list[tuple[int, str]]]:
    """Return the number of records that the header states, else -1, and the numbered lines without comments."""
    data = read_bytes(path)
    try:  # the encodings of JSON: UTF-8, and UTF-16 as PowerShell writes it
        text = io.StringIO(data.decode(json.detect_encoding(data)), newline=None).read()  # with every line break as \n
    except UnicodeDecodeError as error:
        raise _damaged(path, "file", "is no UTF-8 text") from error
    stated = _RECORD_COUNT.findall(text)
    lines = [(line, row) for line, row in enumerate(text.split("\n"), start=1) if not row.startswith("#")]
    return int(stated[-1]) if stated else -1, lines


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    stated, lines = _lines(path)
    rows = [(line, text) for line, text in lines if text.strip()]
    _warn_if_truncated(path, stated, len(rows))
    return ((line, text.split()) for line, text in rows)


def _warn_if_truncated(path: Path, stated: int, count: int) -> None:
    if count < stated:
        _log.warning(
            "%s: its header says %d, and %d are there: if you did not remove any, export it again.", path, stated, count
        )


def _numbers(path: Path, line: int, cells: Sequence[str], kind: Callable[[str], _Number]) -> list[_Number]:
    try:
        return [kind(cell) for cell in cells]
    except ValueError as error:
        comma = "; write a decimal point, not a comma" if any("," in cell for cell in cells) else ""
        raise _damaged(path, f"line {line}", f"is not numeric ({str(error)[:80]}){comma}") from error


def _whole(cell: str) -> int:
    if not -(1 << 63) <= (number := int(cell)) < 1 << 63:
        raise ValueError(f"{cell[:40]} has more than 64 bits")
    return number
