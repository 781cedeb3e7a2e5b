"""PLY files: point clouds in, Gaussians out and in, in the layout that 3DGS made the standard. Strict about counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.view import PointCloud
from clear_strategies.errors import DataError
from clear_strategies.files import write_bytes
from rasterizers.geometry import SH_C0

_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS: Final[dict[str, Literal["<", ">", "="]]] = {
    "binary_little_endian": "<",
    "binary_big_endian": ">",
    "ascii": "=",
}
_LONGEST_HEADER: Final = 1 << 16
_REST_COUNTS: Final = (0, 9, 24, 45)


@dataclass(frozen=True, slots=True, eq=False)
class GaussianPly:
    """Gaussians as the standard layout stores them: raw parameters, everything view-dependent included.

    Args:
        sh0, shN: colour coefficients. opacities: logit. scales: log. quats: wxyz.
    """

    means: Float[Tensor, "N 3"]
    sh0: Float[Tensor, "N 1 3"]
    shN: Float[Tensor, "N B 3"]  # noqa: N815 - gsplat's name
    opacities: Float[Tensor, " N"]
    scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]


def write_gaussians(path: Path, g: GaussianPly, *, comments: Sequence[str] = ("SplatRenderMode: mip",)) -> None:
    """Binary little-endian, atomically.

    Args:
        comments: header comments; "SplatRenderMode: mip" tells viewers to draw with opacity compensation.
    """
    n = len(g.means)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(g.shN.shape[1] * 3)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rest = g.shN.transpose(1, 2).reshape(n, -1)  # channel-major
    columns = (g.means, torch.zeros(n, 3), g.sh0[:, 0], rest, g.opacities[:, None], g.scales, g.quats)
    table = torch.cat([c.detach().cpu().float() for c in columns], dim=1).numpy().astype("<f4")
    _write(path, table.tobytes(), [f"property float {name}" for name in names], n, comments)


def write_points(path: Path, cloud: PointCloud) -> None:
    """Positions and 8-bit colours, atomically."""
    row = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    table = np.zeros(len(cloud), row)
    table["xyz"] = cloud.means.cpu().numpy()
    table["rgb"] = (cloud.colors.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    properties = [f"property float {name}" for name in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    _write(path, table.tobytes(), properties, len(cloud), (cloud.source,))


def read_gaussians(path: Path) -> GaussianPly:
    """Read the standard layout.

    Raises:
        DataError: not such a file: damaged, truncated, or a property is missing or not finite.
    """
    table = _read_vertices(path)
    rest = sorted((name for name in table.dtype.names or () if name.startswith("f_rest_")), key=lambda n: int(n[7:]))
    if len(rest) not in _REST_COUNTS:
        raise DataError(path, "f_rest", f"has {len(rest)} properties where 0, 9, 24 or 45 belong", "export it again")
    higher = _columns(path, table, rest) if rest else torch.zeros(len(table), 0)
    return GaussianPly(
        means=_columns(path, table, ["x", "y", "z"]),
        sh0=_columns(path, table, ["f_dc_0", "f_dc_1", "f_dc_2"])[:, None],
        shN=higher.view(len(table), 3, -1).transpose(1, 2).contiguous(),
        opacities=_columns(path, table, ["opacity"])[:, 0],
        scales=_columns(path, table, [f"scale_{i}" for i in range(3)]),
        quats=_columns(path, table, [f"rot_{i}" for i in range(4)]),
    )


def read_points(path: Path) -> PointCloud:
    """Positions and colours (red, green, blue, or f_dc of a Gaussian file); grey where there are none.

    Raises:
        DataError: not a PLY, damaged, truncated, or not finite.
    """
    table = _read_vertices(path)
    names = table.dtype.names or ()
    means = _columns(path, table, ["x", "y", "z"])
    if {"red", "green", "blue"} <= set(names):
        colors = _columns(path, table, ["red", "green", "blue"])
        if table.dtype["red"].kind in "iu":
            colors = colors / float(np.iinfo(table.dtype["red"]).max)
    elif "f_dc_0" in names:
        colors = _columns(path, table, ["f_dc_0", "f_dc_1", "f_dc_2"]) * SH_C0 + 0.5
    else:
        colors = torch.full_like(means, 0.5)
    return PointCloud(means, colors.clamp(0, 1), source=f"PLY {path.name}", saw_test_views="unknown")


def _write(path: Path, data: bytes, properties: Sequence[str], n: int, comments: Sequence[str]) -> None:
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {' '.join(c.split())}" for c in comments)]
    lines += [f"element vertex {n}", *properties, "end_header"]
    write_bytes(path, "\n".join(lines).encode() + b"\n" + data)


def _read_vertices(path: Path) -> np.ndarray:
    """The vertex element as a structured array; every count is held against the bytes that are there."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(path, "file", f"cannot be read ({error.strerror})", "check the path") from error
    order, count, row, body = _parse_header(path, data)
    if order == "ascii":
        return _read_ascii(path, data[body:], count, row)
    needed, left = count * row.itemsize, len(data) - body
    if needed > left:
        problem = f"says {count} vertices of {row.itemsize} bytes, but {left} bytes are left"
        raise DataError(path, "element vertex", problem, "the file is truncated; write it again")
    return np.frombuffer(data, row.newbyteorder(_ORDERS[order]), count, body)


def _parse_header(path: Path, data: bytes) -> tuple[str, int, np.dtype, int]:  # noqa: PLR0912 - one case a line
    """(format, vertex count, row type, where the body starts)."""
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise DataError(path, "header", "is no PLY header", "give a .ply file")
    newline = data.find(b"\n", end)
    if newline < 0:
        raise DataError(path, "header", "has no body after end_header", "the file is truncated; write it again")
    order, count, elements, properties = "", -1, 0, []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if kind in _ORDERS:
                order = kind
            case ["element", "vertex", number] if number.isdigit() and len(number) < 16 and elements == 0:
                count, elements = int(number), 1
            case ["element", _, number] if number.isdigit() and count >= 0:
                elements += 1  # faces and the like may follow; they are not read
            case ["property", kind, name] if kind in _TYPES:
                if elements == 1:
                    properties.append((name, _TYPES[kind]))
            case ["property", "list", *_] if elements > 1:
                continue
            case _:
                raise DataError(path, "header", f"has a line that is not understood: {line[:80]!r}", "export it again")
    if not order or count < 0:
        raise DataError(path, "header", "lacks its format or `element vertex` as the first element", "export it again")
    if not properties or len({name for name, _ in properties}) != len(properties):
        raise DataError(path, "element vertex", "has no property, or one twice", "export it again")
    return order, count, np.dtype(properties), newline + 1


def _read_ascii(path: Path, body: bytes, count: int, row: np.dtype) -> np.ndarray:
    lines = body.decode("latin-1").splitlines()
    if count > len(lines):
        problem = f"says {count} vertices, but {len(lines)} lines are left"
        raise DataError(path, "element vertex", problem, "the file is truncated; write it again")
    width = len(row.names or ())
    table = np.zeros(count, row)
    for i, line in enumerate(lines[:count]):
        cells = line.split()
        if len(cells) != width:
            raise DataError(path, f"vertex {i}", f"has {len(cells)} values where {width} belong", "export it again")
        try:
            table[i] = tuple(float(c) if row[k].kind == "f" else int(c) for k, c in enumerate(cells))
        except (ValueError, OverflowError) as error:
            raise DataError(path, f"vertex {i}", f"is not numeric ({error})", "export it again") from error
    return table


def _columns(path: Path, table: np.ndarray, names: Sequence[str]) -> Float[Tensor, "N C"]:
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise DataError(
            path, missing[0], "is missing from the vertices", "export with all properties of the 3DGS layout"
        )
    columns = np.stack([table[name].astype(np.float32) for name in names], axis=1)
    if not np.isfinite(columns).all():
        row = int(np.flatnonzero(~np.isfinite(columns).all(1))[0])
        raise DataError(path, ", ".join(names), f"is not finite in vertex {row}", "remove the vertex")
    return torch.from_numpy(columns)
