"""The vertices of a PLY file, ascii or binary, as a table.

The reader is strict: the header has a largest size, and its counts are compared with the file's size before anything is
allocated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.lib.recfunctions import structured_to_unstructured
from torch import Tensor

from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes

_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_FORMATS: Final = ("ascii", "binary_little_endian", "binary_big_endian")
_LONGEST_HEADER: Final = 1 << 16  # bytes
_LONGEST_COUNT: Final = 20  # digits


@dataclass(frozen=True, slots=True)
class _Element:
    """`element name count`, and the names and types of its row; None if a list makes rows of unequal length."""

    name: str
    count: int
    row: dict[str, str] | None

    @property
    def dtype(self) -> np.dtype[np.void]:
        return np.dtype(list((self.row or {}).items()))

    def size(self, ascii_: bool) -> int:
        """Values in an ASCII file, bytes in a binary one."""
        return self.count * (len(self.row or {}) if ascii_ else self.dtype.itemsize)


def read_vertices(path: Path) -> np.ndarray:
    """The vertex element as a structured array."""
    data = read_bytes(path)
    form, elements, start = _parse_header(path, data[:_LONGEST_HEADER])
    at = next((i for i, e in enumerate(elements) if e.name == "vertex"), len(elements))
    if at == len(elements) or not elements[at].row:
        raise DataError(path, "element vertex", "is missing or has no properties", "give a file of points")
    if any(e.row is None for e in elements[:at]):
        raise DataError(path, "element vertex", "comes after an element with lists", "write the vertices first")
    vertex, ascii_ = elements[at], form == "ascii"
    # Line breaks in ASCII files have no meaning, so values are counted.
    body: Any = data[start:].split() if ascii_ else data[start:]
    before, after = (sum(e.size(ascii_) for e in part) for part in (elements[:at], elements[at + 1 :]))
    needed, left, unit = before + vertex.size(ascii_), len(body), "values" if ascii_ else "bytes"
    if needed > left:
        problem = f"has a count of {vertex.count}, which needs {needed} {unit}, but {left} are left"
        raise DataError(path, "element vertex", problem, "the file is truncated; write it again")
    if all(e.row is not None for e in elements) and needed + after != left:
        problem = f"needs {needed + after} {unit} after it, but {left} follow"
        raise DataError(path, "header", problem, "the file is damaged; write it again")
    if ascii_:
        return _of_words(path, vertex, body[before:needed])
    row = vertex.dtype.newbyteorder("<" if form == "binary_little_endian" else ">")
    return np.frombuffer(body, row, vertex.count, before)


def _of_words(path: Path, vertex: _Element, words: Sequence[bytes]) -> np.ndarray:
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError(path, "element vertex", f"is not numeric ({error})", "export it again") from error
    table = np.zeros(vertex.count, vertex.dtype)
    for name, column in zip(names_of(table), numbers.reshape(-1, len(names_of(table))).T, strict=True):
        kind = table.dtype[name]
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            wrong = ~((column >= limits.min) & (column <= limits.max) & (column == np.round(column)))
            if wrong.any():
                problem = f"must be whole and in [{limits.min}, {limits.max}], is {column[wrong][0]:g}"
                raise DataError(path, name, problem, "export it again")
        with np.errstate(over="ignore"):  # overflow gives infinity, which `columns` refuses
            table[name] = column
    return table


def _parse_header(path: Path, head: bytes) -> tuple[str, list[_Element], int]:
    """(format, elements, offset of the first byte after the header)."""
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
    return form, elements, body


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


def names_of(table: np.ndarray) -> tuple[str, ...]:
    return table.dtype.names or ()


def columns(
    path: Path, table: np.ndarray, names: Sequence[str], *, infinite: float | None = None
) -> Float[Tensor, "N C"]:
    """Properties as float32; each must exist and be finite, unless this number stands for infinity."""
    missing = [name for name in names if name not in names_of(table)]
    if missing:
        problem = f"is missing from the vertices, which have {', '.join(names_of(table))}"
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
