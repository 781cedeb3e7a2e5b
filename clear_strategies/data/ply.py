"""Reading and writing of PLY files: Gaussians in the layout of 3DGS, and point clouds.

The reader is strict: counts are compared with the file's size before anything is allocated. (plyfile would make this shorter; its
licence, GPL-3.0, does not go with this package's.)
"""

from __future__ import annotations

import logging
import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.lib.recfunctions import structured_to_unstructured
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes, write_bytes
from rasterizers.geometry import SH_C0

_log = logging.getLogger(__name__)

_BANDS: Final = (0, 3, 8, 15)  # (degree + 1)² - 1
_MIP: Final = "SplatRenderMode: mip"  # tells viewers to draw with opacity compensation
_FLAT: Final = -30.0  # logarithm of a scale that no pixel shows
_OPAQUE: Final = 16.0  # logit: sigmoid gives 1 as closely as float32 tells it from 1

_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS: Final[dict[str, Literal["=", "<", ">"]]] = {
    "ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">",
}  # fmt: skip
_LONGEST_HEADER: Final = 1 << 16  # bytes
_COUNT: Final = re.compile(r"[0-9]{1,18}")

_XYZ: Final = ("x", "y", "z")
_NORMAL: Final = ("nx", "ny", "nz")
_RGB: Final = ("red", "green", "blue")
_DC: Final = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE: Final = ("scale_0", "scale_1", "scale_2")
_ROTATION: Final = ("rot_0", "rot_1", "rot_2", "rot_3")


@dataclass(frozen=True, slots=True, eq=False)
class GaussianPly:
    """Raw parameters of Gaussians, as the layout of 3DGS stores them, with B in {0, 3, 8, 15} bands of view-dependent colour."""

    means: Float[Tensor, "N 3"]
    sh0: Float[Tensor, "N 1 3"]
    shN: Float[Tensor, "N B 3"]  # noqa: N815 - gsplat's name
    opacities: Float[Tensor, " N"]  # logits
    scales: Float[Tensor, "N 3"]  # natural logarithms
    quats: Float[Tensor, "N 4"]  # wxyz, any norm
    antialiased: bool = True  # drawn with opacity compensation, as they were trained: see `RasterSettings`

    def __len__(self) -> int:
        return self.means.shape[0]


def write_gaussians(path: Path | str, g: GaussianPly) -> None:
    """Write Gaussians, binary little-endian, atomically; a ValueError if a number is not finite."""
    rest = g.shN.transpose(1, 2).reshape(len(g), g.shN.shape[1] * 3)  # channel-major
    groups = (
        (_XYZ, g.means), (_NORMAL, torch.zeros_like(g.means)), (_DC, g.sh0[:, 0]), (_rest_names(rest.shape[1]), rest),
        (("opacity",), g.opacities[:, None]), (_SCALE, g.scales), (_ROTATION, g.quats),
    )  # fmt: skip
    _write(Path(path), groups, (_MIP,) if g.antialiased else ())


def read_gaussians(path: Path | str, *, allow_empty: bool = True) -> GaussianPly:
    """Read the standard layout. Other properties are ignored, with a warning that names them.

    Opacities of exactly 0 and 1, whose logits are infinite, are read, since formats of 8 bits have them, and so are scales of 0.

    Raises:
        DataError: the file has another layout, or no Gaussians and not `allow_empty`.
    """
    path = Path(path)
    table, comments = _read_vertices(path)
    if not len(table) and not allow_empty:
        raise DataError(path, "element vertex", "has no Gaussians", "export it again")
    rest = _rest_names(sum(name.startswith("f_rest_") for name in _names_of(table)))
    if len(rest) not in {3 * bands for bands in _BANDS}:
        raise DataError(path, "f_rest", f"has {len(rest)} properties where 0, 9, 24 or 45 belong", "export it again")
    layout = {*_XYZ, *_NORMAL, *_DC, *rest, "opacity", *_SCALE, *_ROTATION}
    extra = [name for name in _names_of(table) if name not in layout]
    if extra:
        _log.warning("%s: %s: not in the 3DGS layout, not read.", path, ", ".join(extra))
    return GaussianPly(
        means=_columns(path, table, _XYZ),
        sh0=_columns(path, table, _DC)[:, None],
        shN=_columns(path, table, rest).view(len(table), 3, len(rest) // 3).transpose(1, 2).contiguous(),
        opacities=_columns(path, table, ("opacity",), infinite=(-_OPAQUE, _OPAQUE))[:, 0],
        scales=_columns(path, table, _SCALE, infinite=(_FLAT, math.inf)),
        quats=_columns(path, table, _ROTATION),
        antialiased=_MIP in comments,
    )


def write_points(path: Path | str, means: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"]) -> None:
    """Write points in the layout of 3DGS' points3D.ply: positions, normals of 0, and colours (RGB in [0, 1]) as 8 bits. Binary
    little-endian, atomically; a ValueError for a wrong shape, a colour out of range or a number that is not finite.
    """
    n = len(means)
    if tuple(means.shape) != (n, 3) or tuple(colors.shape) != (n, 3):
        given = f"{tuple(means.shape)} and {tuple(colors.shape)}"
        raise ValueError(f"means and colors must have shape [N, 3], got {given}.")
    if not bool(((colors >= 0) & (colors <= 1)).all()):
        raise ValueError("colors must lie in [0, 1]: divide 8-bit values by 255.")
    levels = (colors.detach().cpu() * 255).round().to(torch.uint8)
    _write(Path(path), ((_XYZ, means), (_NORMAL, torch.zeros_like(means)), (_RGB, levels)))


def _write(path: Path, groups: Sequence[tuple[Sequence[str], Tensor]], comments: Sequence[str] = ()) -> None:
    """Write vertices with groups of properties: the names of C properties, and their values [N, C], floats or bytes."""
    columns = {
        name: (values[:, k].detach().cpu().numpy(), "uchar" if values.dtype == torch.uint8 else "float")
        for names, values in groups for k, name in enumerate(names)
    }  # fmt: skip
    table = np.zeros(
        len(groups[0][1]), [(name, "u1" if kind == "uchar" else "<f4") for name, (_, kind) in columns.items()]
    )
    for name, (values, _) in columns.items():
        if not (finite := np.isfinite(values)).all():
            i = np.flatnonzero(~finite)[0]
            raise ValueError(f"a PLY file must have finite numbers, got {name} = {values[i]} in number {i}: remove it.")
        table[name] = values
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {' '.join(c.split())}" for c in comments)]
    lines += [f"element vertex {len(table)}", *(f"property {kind} {name}" for name, (_, kind) in columns.items())]
    # Some readers expect ASCII headers.
    write_bytes(path, "\n".join([*lines, "end_header\n"]).encode("ascii", "replace") + table.tobytes())


def read_points(path: Path | str) -> PointCloud:
    """Read positions and colours: red, green, blue (8 or 16 bits, or floats in [0, 1]), or f_dc of Gaussians, else grey."""
    path = Path(path)
    table, _ = _read_vertices(path)
    names = set(_names_of(table))
    means = _columns(path, table, _XYZ)
    if names & set(_RGB):
        colors, how = _rgb(path, table), ""
    elif names & set(_DC):
        colors, how = (_columns(path, table, _DC) * SH_C0 + 0.5).clamp(0, 1), ", the centres of Gaussians"
    else:
        colors, how = torch.full_like(means, 0.5), ", without colours"
        _log.warning("%s: no colours, so its points are grey.", path)
    return PointCloud(means, colors, f"{len(means):,} points of {path.name}{how}", uses_test_views="unknown")


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _rgb(path: Path, table: np.ndarray) -> Float[Tensor, "N 3"]:
    """Colours in [0, 1], to which the full range of 8-bit or 16-bit unsigned integers is mapped."""
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


def _read_vertices(path: Path) -> tuple[np.ndarray, str]:
    """Read the vertices, which must be the file's first element, as a structured array; also returns the header."""
    data = read_bytes(path)
    head = data[:_LONGEST_HEADER]
    if not (first := re.match(rb"(?:\xef\xbb\xbf)?\s*ply\s*\n", head)):
        raise DataError(path, "header", "does not begin with a line `ply`", "give a .ply file")
    if not (last := re.search(rb"^[ \t]*end_header[ \t\r]*\n", head, re.MULTILINE)):
        problem = f"has no line `end_header` in its first {_LONGEST_HEADER} bytes"
        raise DataError(path, "header", problem, "the file is truncated; write it again")
    header, start = head[first.end() : last.start()].decode("latin-1"), last.end()
    form, count, row, alone = _parse_header(path, header)
    dtype = np.dtype(row).newbyteorder(_BYTE_ORDERS[form])
    lines: list[str] = []
    if form == "ascii":
        lines = [line for line in data[start:].decode("latin-1").splitlines() if line.strip()]
        needed, left, unit = count, len(lines), "rows"
    else:
        needed, left, unit = count * dtype.itemsize, len(data) - start, "bytes"
    if needed > left or (needed < left and alone):
        problem = f"has a count of {count}, which needs {needed} {unit}, but {left} follow"
        raise DataError(path, "element vertex", problem, "the file is truncated or damaged; write it again")
    if form != "ascii":
        return np.frombuffer(data, dtype, count, start), header
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # versions of numpy warn of a fraction where a whole number belongs
            return np.loadtxt(lines[:count], dtype, comments=None, ndmin=1) if count else np.zeros(0, dtype), header
    except (ValueError, OverflowError, Warning) as error:
        problem = f"cannot be read ({str(error).partition(';')[0]})"
        raise DataError(path, "element vertex", problem, "export it again") from error


def _parse_header(path: Path, header: str) -> tuple[str, int, list[tuple[str, str]], bool]:
    """Return the format, the number of vertices, the name and type of their properties, and True if no element follows."""
    if "packed_position" in header:
        remedy = f"convert it: splat-transform {path.name} {path.name.removesuffix('.ply').removesuffix('.compressed')}-plain.ply"
        raise DataError(path, "format", "is SuperSplat's compressed PLY, which is not read", remedy)
    form, counts, row = "", dict[str, int](), dict[str, str]()
    for line in header.splitlines():
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if kind in _BYTE_ORDERS and not form:
                form = kind
            case ["element", name, count] if form and _COUNT.fullmatch(count) and name not in counts:
                counts[name] = int(count)
            case ["property", kind, name] if [*counts] == ["vertex"] and kind in _TYPES and name not in row:
                row[name] = _TYPES[kind]
            case ["property", *_] if len(counts) > 1:
                continue  # of an element that is not read
            case _:
                problem = f"has a line that is not understood there: {line[:80]!r}"
                raise DataError(path, "header", problem, "export it again: first the vertices, of plain numbers")
    if not row:
        raise DataError(path, "element vertex", "is missing or has no properties", "give a file of points")
    return form, counts["vertex"], list(row.items()), len(counts) == 1


def _names_of(table: np.ndarray) -> tuple[str, ...]:
    return table.dtype.names or ()


def _columns(
    path: Path, table: np.ndarray, names: Sequence[str], *, infinite: tuple[float, float] = (-math.inf, math.inf)
) -> Float[Tensor, "N C"]:
    """Return properties as float32. They must exist and be finite, or `infinite` gives the numbers that replace -inf and inf."""
    missing = [name for name in names if name not in _names_of(table)]
    if missing:
        problem = f"is missing from the vertices, which have {', '.join(_names_of(table))}"
        raise DataError(path, missing[0], problem, "export it again, with this property")
    with np.errstate(over="ignore"):  # overflow gives infinity
        values = np.array(structured_to_unstructured(table[list(names)], np.float32))
    values = np.nan_to_num(values, nan=np.nan, neginf=infinite[0], posinf=infinite[1])
    finite = np.isfinite(values)
    if not finite.all():
        i, k = np.argwhere(~finite)[0]
        raise DataError(path, names[k], f"is not finite in vertex {i}", "remove the vertex, or export it again")
    return torch.from_numpy(values)
