"""PLY files: Gaussians in the standard layout of 3DGS and point clouds, in and out.

The reader is strict: the header has a largest size, and its counts are compared with the file's size before anything is
allocated.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.lib.recfunctions import structured_to_unstructured
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.errors import DataError
from clear_strategies.files import require_regular, write_bytes
from rasterizers.geometry import SH_C0

_log = logging.getLogger(__name__)

_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_FORMATS: Final = ("ascii", "binary_little_endian", "binary_big_endian")
_LONGEST_HEADER: Final = 1 << 16  # bytes
_LONGEST_COUNT: Final = 20  # digits
_BANDS: Final = (0, 3, 8, 15)  # (degree + 1)² - 1
_OPAQUE: Final = 16.0  # logit: sigmoid gives 1 as closely as float32 tells it from 1

_XYZ: Final = ("x", "y", "z")
_NORMAL: Final = ("nx", "ny", "nz")
_RGB: Final = ("red", "green", "blue")
_DC: Final = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE: Final = ("scale_0", "scale_1", "scale_2")
_ROTATION: Final = ("rot_0", "rot_1", "rot_2", "rot_3")


@dataclass(frozen=True, slots=True, eq=False)
class GaussianPly:
    """Gaussians in the standard layout: raw parameters, view-dependent colour included.

    Args:
        sh0, shN: colour as spherical harmonics; B in {0, 3, 8, 15} bands in `shN`.
        opacities: logit. scales: natural logarithm. quats: wxyz, any norm.

    Raises:
        ValueError: the shapes do not match.
    """

    means: Float[Tensor, "N 3"]
    sh0: Float[Tensor, "N 1 3"]
    shN: Float[Tensor, "N B 3"]  # noqa: N815 - gsplat's name
    opacities: Float[Tensor, " N"]
    scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]

    def __post_init__(self) -> None:
        n, bands = len(self.means), self.shN.shape[1]
        if bands not in _BANDS:
            raise ValueError(f"shN must have 0, 3, 8 or 15 bands, got {bands}.")
        shapes = {"means": (n, 3), "sh0": (n, 1, 3), "shN": (n, bands, 3), "opacities": (n,)}
        for name, shape in {**shapes, "scales": (n, 3), "quats": (n, 4)}.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"{name} must have shape {shape}, got {found}.")

    def __len__(self) -> int:
        return self.means.shape[0]


def write_gaussians(path: Path, g: GaussianPly, *, comments: Sequence[str] = ("SplatRenderMode: mip",)) -> None:
    """Binary little-endian, atomically.

    Args:
        comments: header comments; "SplatRenderMode: mip" tells viewers to draw with opacity compensation.

    Raises:
        ValueError: a number is not finite.
    """
    rest = g.shN.transpose(1, 2).reshape(len(g), g.shN.shape[1] * 3)  # channel-major
    groups = (
        (_XYZ, g.means), (_NORMAL, torch.zeros_like(g.means)), (_DC, g.sh0[:, 0]), (_rest_names(rest.shape[1]), rest),
        (("opacity",), g.opacities[:, None]), (_SCALE, g.scales), (_ROTATION, g.quats),
    )  # fmt: skip
    names = [name for group, _ in groups for name in group]
    columns = torch.cat([values.detach().cpu().float() for _, values in groups], dim=1).numpy()
    finite = np.isfinite(columns)
    if not finite.all():
        i, k = np.argwhere(~finite)[0]
        raise ValueError(f"Gaussians must be finite, got {names[k]} = {columns[i, k]} in number {i}.")
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {' '.join(c.split())}" for c in comments)]
    lines += [f"element vertex {len(g)}", *(f"property float {name}" for name in names), "end_header\n"]
    # Some readers expect ASCII headers.
    write_bytes(path, "\n".join(lines).encode("ascii", "replace") + columns.astype("<f4").tobytes())


def read_gaussians(path: Path) -> GaussianPly:
    """Read the standard layout. Other properties are ignored, with a warning that names them.

    Opacities of exactly 0 and 1, whose logits are infinite, are read: formats of 8 bits have them.

    Raises:
        DataError: the file is damaged or truncated, or a property is missing or not finite.
    """
    table = _read_vertices(path)
    rest = _rest_names(sum(name.startswith("f_rest_") for name in _names(table)))
    if len(rest) not in {3 * bands for bands in _BANDS}:
        raise DataError(path, "f_rest", f"has {len(rest)} properties where 0, 9, 24 or 45 belong", "export it again")
    layout = {*_XYZ, *_NORMAL, *_DC, *rest, "opacity", *_SCALE, *_ROTATION}
    extra = [name for name in _names(table) if name not in layout]
    if extra:
        _log.warning("%s: %s: not in the 3DGS layout, not read.", path, ", ".join(extra))
    return GaussianPly(
        means=_columns(path, table, _XYZ),
        sh0=_columns(path, table, _DC)[:, None],
        shN=_columns(path, table, rest).view(len(table), 3, len(rest) // 3).transpose(1, 2).contiguous(),
        opacities=_columns(path, table, ("opacity",), infinite=_OPAQUE)[:, 0],
        scales=_columns(path, table, _SCALE),
        quats=_columns(path, table, _ROTATION),
    )


def write_points(path: Path | str, means: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"]) -> None:
    """Positions, normals of 0, and 8-bit colours: the layout of 3DGS' points3D.ply. Binary little-endian, atomically.

    Args:
        means: world units.
        colors: RGB in [0, 1].

    Raises:
        ValueError: the shapes do not match, a position is not finite, or a colour is out of range.
    """
    n = len(means)
    if tuple(means.shape) != (n, 3) or tuple(colors.shape) != (n, 3):
        raise ValueError(
            f"means and colors must have shape [N, 3], got {tuple(means.shape)} and {tuple(colors.shape)}."
        )
    if not bool(means.isfinite().all()):
        raise ValueError("means must be finite: remove the other points.")
    if not bool(((colors >= 0) & (colors <= 1)).all()):
        raise ValueError("colors must lie in [0, 1]: divide 8-bit values by 255.")
    row = [*((name, "<f4") for name in (*_XYZ, *_NORMAL)), *((name, "u1") for name in _RGB)]
    table = np.zeros(n, row)
    for k in range(3):
        table[_XYZ[k]] = means[:, k].detach().cpu().numpy()
        table[_RGB[k]] = (colors[:, k].detach().cpu() * 255).round().numpy()
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    lines += [f"property float {name}" for name in (*_XYZ, *_NORMAL)]
    lines += [*(f"property uchar {name}" for name in _RGB), "end_header\n"]
    write_bytes(Path(path), "\n".join(lines).encode() + table.tobytes())


def read_points(path: Path) -> PointCloud:
    """Read positions and colours: red, green, blue (8 or 16 bits, or floats in [0, 1]), or f_dc of Gaussians, else grey.

    Raises:
        DataError: the file is no PLY, is damaged or truncated, is not finite, or has colours out of range.
    """
    table = _read_vertices(path)
    names = set(_names(table))
    means = _columns(path, table, _XYZ)
    if names & set(_RGB):
        colors, how = _rgb(path, table), ""
    elif names & set(_DC):
        colors, how = (_columns(path, table, _DC) * SH_C0 + 0.5).clamp(0, 1), ", the centres of Gaussians"
    else:
        colors, how = torch.full_like(means, 0.5), ", without colours"
        _log.warning("%s: no colours, so its points are grey.", path)
    return PointCloud(means, colors, f"{len(means):,} points of {path.name}{how}", uses_test_views="unknown")


@dataclass(frozen=True, slots=True)
class _Element:
    """`element name count`, and the names and types of its row; None if a list makes rows of unequal length."""

    name: str
    count: int
    row: dict[str, str] | None

    @property
    def dtype(self) -> np.dtype[np.void]:
        return np.dtype(list((self.row or {}).items()))

    @property
    def bytes(self) -> int:
        return self.count * self.dtype.itemsize

    @property
    def values(self) -> int:
        return self.count * len(self.row or {})


@dataclass(frozen=True, slots=True)
class _Header:
    """A file's header: elements before the vertices (all of fixed length), the vertices, elements after them.

    Args:
        body: offset of the first byte after the header.
    """

    form: str
    before: tuple[_Element, ...]
    vertex: _Element
    after: tuple[_Element, ...]
    body: int


def _read_vertices(path: Path) -> np.ndarray:
    """The vertex element as a structured array."""
    require_regular(path)
    try:
        with path.open("rb") as file:
            header = _parse_header(path, file.read(_LONGEST_HEADER))
            file.seek(header.body)
            if header.form == "ascii":
                return _read_ascii(path, header, file.read())
            return _read_binary(path, header, file, path.stat().st_size - header.body)
    except OSError as error:
        raise DataError(path, "file", f"cannot be read ({error.strerror})", "check the path") from error


def _read_binary(path: Path, header: _Header, file: BinaryIO, left: int) -> np.ndarray:
    vertex, skipped = header.vertex, sum(e.bytes for e in header.before)
    _check_length(path, header, skipped + vertex.bytes, sum(e.bytes for e in header.after), left, "bytes")
    file.seek(skipped, os.SEEK_CUR)
    row = vertex.dtype.newbyteorder("<" if header.form == "binary_little_endian" else ">")
    return np.frombuffer(file.read(vertex.bytes), row, vertex.count)


def _read_ascii(path: Path, header: _Header, body: bytes) -> np.ndarray:
    """By number of values, because line breaks in ASCII PLY files have no meaning."""
    vertex, skipped, words = header.vertex, sum(e.values for e in header.before), body.split()
    _check_length(path, header, skipped + vertex.values, sum(e.values for e in header.after), len(words), "values")
    try:
        numbers = np.array([float(word) for word in words[skipped : skipped + vertex.values]])
    except ValueError as error:
        raise DataError(path, "element vertex", f"is not numeric ({error})", "export it again") from error
    table = np.zeros(vertex.count, vertex.dtype)
    for name, column in zip(_names(table), numbers.reshape(-1, len(_names(table))).T, strict=True):
        kind = table.dtype[name]
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            wrong = ~((column >= limits.min) & (column <= limits.max) & (column == np.round(column)))
            if wrong.any():
                problem = f"must be whole and in [{limits.min}, {limits.max}], is {column[wrong][0]:g}"
                raise DataError(path, name, problem, "export it again")
        with np.errstate(over="ignore"):  # overflow gives infinity, which `_columns` refuses
            table[name] = column
    return table


def _check_length(path: Path, header: _Header, needed: int, after: int, left: int, unit: str) -> None:
    """Compare the header's counts with the data that follow it."""
    if needed > left:
        problem = f"has a count of {header.vertex.count}, which needs {needed} {unit}, but {left} are left"
        raise DataError(path, "element vertex", problem, "the file is truncated; write it again")
    if all(e.row is not None for e in header.after) and needed + after != left:
        problem = f"needs {needed + after} {unit} after it, but {left} follow"
        raise DataError(path, "header", problem, "the file is damaged; write it again")


def _parse_header(path: Path, head: bytes) -> _Header:
    lines, body = _header_lines(path, head)
    form, elements = "", list[_Element]()
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if kind in _FORMATS and not form:
                form = kind
            case ["element", name, count] if form and name not in {e.name for e in elements}:
                elements.append(_Element(name, _count(path, name, count), {}))
            case ["property", "list", _, _, _] if elements and elements[-1].name != "vertex":
                elements[-1] = replace(elements[-1], row=None)
            case ["property", kind, name] if elements and kind in _TYPES and name not in (elements[-1].row or {}):
                if elements[-1].row is not None:
                    elements[-1].row[name] = _TYPES[kind]
            case _:
                problem = f"has a line that is not understood there: {line[:80]!r}"
                raise DataError(path, "header", problem, "export it again, with plain numbers in the vertices")
    at = next((i for i, e in enumerate(elements) if e.name == "vertex"), None)
    if at is None or not elements[at].row:
        raise DataError(path, "element vertex", "is missing or has no properties", "give a file of points")
    before, vertex, after = tuple(elements[:at]), elements[at], tuple(elements[at + 1 :])
    if any(e.row is None for e in before):
        raise DataError(path, "element vertex", "comes after an element with lists", "write the vertices first")
    return _Header(form, before, vertex, after, body)


def _header_lines(path: Path, head: bytes) -> tuple[list[str], int]:
    """(lines between `ply` and `end_header`, offset after them)."""
    if head.split(b"\n", 1)[0].strip() != b"ply":
        raise DataError(path, "header", "does not begin with a line `ply`", "give a .ply file")
    lines, body = list[str](), 0
    for line in head.split(b"\n")[:-1]:  # the rest after the last newline is no whole line
        body += len(line) + 1
        lines.append(line.decode("latin-1").strip())
        if lines[-1] == "end_header":
            return lines[1:-1], body
    problem = f"has no line `end_header` in its first {_LONGEST_HEADER} bytes"
    raise DataError(path, "header", problem, "the file is truncated; write it again")


def _count(path: Path, element: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= _LONGEST_COUNT):
        problem = f"must have a whole number >= 0 as its count, has {text[:40]!r}"
        raise DataError(path, f"element {element}", problem, "export it again")
    return int(text)


def _names(table: np.ndarray) -> tuple[str, ...]:
    return table.dtype.names or ()


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _rgb(path: Path, table: np.ndarray) -> Float[Tensor, "N 3"]:
    """Colours in [0, 1]; the full range of 8-bit or 16-bit unsigned integers is mapped to it."""
    colors = _columns(path, table, _RGB)
    kinds = {table.dtype[name].str[1:] for name in _RGB}
    if kinds <= {"u1"} or kinds <= {"u2"}:
        return colors / (255 if kinds <= {"u1"} else 65535)
    if not all(kind.startswith("f") for kind in kinds):
        raise DataError(path, "red, green, blue", "must be all uchar, ushort or floats", "export it again")
    if len(colors) and not (colors.min() >= 0 and colors.max() <= 1):
        problem = f"must lie in [0, 1] where they are floats, span [{colors.min():g}, {colors.max():g}]"
        raise DataError(path, "red, green, blue", problem, "scale the colours, or export them as uchar")
    return colors


def _columns(
    path: Path, table: np.ndarray, names: Sequence[str], *, infinite: float | None = None
) -> Float[Tensor, "N C"]:
    """Properties as float32; each must exist and be finite, unless this number stands for infinity."""
    missing = [name for name in names if name not in _names(table)]
    if missing:
        problem = f"is missing from the vertices, which have {', '.join(_names(table))}"
        raise DataError(path, missing[0], problem, "export it again, with this property")
    with np.errstate(over="ignore"):  # overflow gives infinity
        columns = np.array(structured_to_unstructured(table[list(names)], np.float32))
    if infinite is not None:
        columns = np.where(np.isinf(columns), np.copysign(np.float32(infinite), columns), columns)
    finite = np.isfinite(columns)
    if not finite.all():
        i, k = np.argwhere(~finite)[0]
        raise DataError(path, names[k], f"is not finite in vertex {i}", "remove the vertex, or export it again")
    return torch.from_numpy(columns)
