"""COLMAP's cameras.txt, images.txt and points3D.txt."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from clear_strategies.data.cameras import Lens
from clear_strategies.data.readers import colmap_records as records
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes

_NUMBER: Final = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
_WHOLE: Final = re.compile(r"-?[0-9]{1,18}")


def cameras(path: Path) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    for line, cells in _lines(path):
        if len(cells) < 4:
            raise records.damaged(path, f"line {line}", f"has {len(cells)} of at least 5 columns")
        width, height = _integer(path, line, cells[2]), _integer(path, line, cells[3])
        expected = records.parameters_of(path, cells[1])
        if len(cells) != 4 + expected:
            raise records.damaged(path, f"line {line}", f"has {len(cells) - 4} parameters, {cells[1]} has {expected}")
        parameters = tuple(_number(path, line, c) for c in cells[4:])
        lens = records.lens_of(path, f"line {line}", cells[1], width, height, parameters)
        records.put(path, lenses, _integer(path, line, cells[0]), lens)
    return lenses


def images(path: Path) -> list[records.Image]:
    """Two lines per image: its pose, then its 2D points, which are not used and may be none."""
    found: dict[int, records.Image] = {}
    lines = iter(_raw_lines(path))
    for line, text in lines:
        if not text.strip() or text.startswith("#"):
            continue
        cells = text.split(maxsplit=9)
        if len(cells) != 10:
            raise records.damaged(path, f"line {line}", f"has {len(cells)} of 10 columns")
        number, camera = _integer(path, line, cells[0]), _integer(path, line, cells[8])
        pose = tuple(_number(path, line, c) for c in cells[1:8])
        records.put(path, found, number, records.image_of(path, number, pose, camera, cells[9].strip()))
        second = next(lines, None)
        if second is None or len(second[1].split()) % 3 or second[1].startswith("#"):
            problem = "is no line of 2D points (X Y POINT3D_ID, or empty) for the image above it"
            raise records.damaged(path, f"line {line + 1}", problem)
    return list(found.values())


def points(path: Path) -> records.Points:
    means, colors, track, ids = list[list[float]](), list[list[int]](), [], set()
    for line, cells in _lines(path):
        if len(cells) < 8 or len(cells) % 2:
            raise records.damaged(path, f"line {line}", f"has {len(cells)} columns where 8 and pairs belong")
        means.append([_number(path, line, c) for c in cells[1:4]])
        rgb = [_integer(path, line, c) for c in cells[4:7]]
        if not all(0 <= c <= 255 for c in rgb):
            raise DataError(path, f"line {line}", f"has the colour {rgb}", "colours lie in 0..255")
        colors.append(rgb)
        ids.add(_integer(path, line, cells[0]))
        track.append(np.array([_integer(path, line, c) for c in cells[8::2]], np.int64))
    return records.checked_points(path, ids, means, colors, track)


def _raw_lines(path: Path) -> list[tuple[int, str]]:
    try:
        text = io.StringIO(read_bytes(path).decode(), newline=None).read()  # with every line break as \n
    except UnicodeDecodeError as error:
        raise records.damaged(path, "file", "is no UTF-8 text") from error
    if text.startswith("\ufeff"):
        raise DataError(path, "line 1", "starts with a byte-order mark", "save it as UTF-8 without one")
    return list(enumerate(text.split("\n"), start=1))


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, text in _raw_lines(path):
        if text.strip() and not text.startswith("#"):
            yield number, text.split()


def _number(path: Path, line: int, cell: str) -> float:
    if not _NUMBER.fullmatch(cell):
        comma = "; write a decimal point, not a comma" if "," in cell else ""
        raise records.damaged(path, f"line {line}", f"has {cell[:40]!r} where a finite number belongs{comma}")
    return float(cell)


def _integer(path: Path, line: int, cell: str) -> int:
    if not _WHOLE.fullmatch(cell):
        raise records.damaged(path, f"line {line}", f"has {cell[:40]!r} where a whole number belongs")
    return int(cell)
