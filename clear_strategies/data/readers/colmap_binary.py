"""COLMAP's cameras.bin, images.bin and points3D.bin.

Every count is compared with the bytes that are left before anything is allocated, and no byte may be left over.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Final

import numpy as np

from clear_strategies.data.cameras import Lens
from clear_strategies.data.readers import colmap_records as records
from clear_strategies.files import read_bytes

_LONGEST_NAME: Final = 4096


def cameras(path: Path) -> dict[int, Lens]:
    file = _Bytes(path)
    lenses: dict[int, Lens] = {}
    for i in range(file.count("number of cameras", 24 + 3 * 8)):
        number, kind, width, height = (int(x) for x in file.take("<iiQQ", f"camera {i}"))
        name = records.MODEL_OF_ID.get(kind, f"number {kind}")
        parameters = file.take(f"<{records.parameters_of(path, name)}d", f"parameters of camera {i}")
        records.put(path, lenses, number, records.lens_of(path, f"camera {number}", name, width, height, parameters))
    file.finish()
    return lenses


def images(path: Path) -> list[records.Image]:
    file = _Bytes(path)
    found: dict[int, records.Image] = {}
    for i in range(file.count("number of images", 4 + 7 * 8 + 4 + 1 + 8)):
        field = f"image {i}"
        number, *pose = file.take("<i7d", field)
        (camera,) = file.take("<i", field)
        name = file.text(f"name of image {i}")
        file.skip(24 * file.count(f"2D points of {name!r}", 24))
        records.put(path, found, int(number), records.image_of(path, int(number), tuple(pose), int(camera), name))
    file.finish()
    return list(found.values())


def points(path: Path) -> records.Points:
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
    return records.checked_points(path, ids, means, colors, track)


class _Bytes:
    """A file's bytes, read from front to back; reading past the end is an error."""

    def __init__(self, path: Path) -> None:
        self.data, self.path, self.at = read_bytes(path), path, 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, layout: str, field: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        if size > self.left:
            raise records.damaged(self.path, field, f"needs {size} bytes, {self.left} are left: truncated")
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += size
        return values

    def count(self, field: str, record: int) -> int:
        """A 64-bit count of records of at least `record` bytes each."""
        (n,) = self.take("<Q", field)
        if n * record > self.left:
            raise records.damaged(
                self.path, field, f"is {n}, of {record} bytes or more each, but {self.left} bytes are left"
            )
        return int(n)

    def skip(self, size: int) -> None:
        self.at += size

    def text(self, field: str) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise records.damaged(self.path, field, "is no text that ends")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise records.damaged(self.path, field, "is no UTF-8 text") from error

    def finish(self) -> None:
        if self.left:
            raise records.damaged(self.path, "end", f"{self.left} bytes are left over")
