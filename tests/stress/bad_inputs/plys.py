"""PLY files of Gaussians and of points."""

import struct
from collections.abc import Mapping

from clear_strategies.data.ply import read_gaussians, read_points
from tests.stress.bad_inputs import BadInput, at

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
         "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
_GOOD = dict.fromkeys(NAMES, 0.5)
_BINARY = "format binary_little_endian 1.0"


def ply(*, first: str = "ply", form: str = _BINARY, count: object = 2, rows: Mapping[str, object] = _GOOD,
        more: str = "", end: str = "end_header\n", body: bytes | None = None) -> bytes:  # fmt: skip
    """A file of two Gaussians, with whatever is given in place of the sound part."""
    lines = [first, form, f"element vertex {count}", *(f"property float {name}" for name in rows), *more.split(";")]
    data = struct.pack(f"<{len(rows)}f", *rows.values()) * 2 if body is None else body
    return "\n".join(line for line in [*lines, end] if line).encode() + data


def _without(name: str) -> dict[str, object]:
    return {key: value for key, value in _GOOD.items() if key != name}


def _text(body: str, *properties: str) -> bytes:
    """An ASCII file of one point."""
    xyz = [f"property float {name}" for name in "xyz"]
    return "\n".join(["ply", "format ascii 1.0", "element vertex 1", *xyz, *properties, "end_header", body]).encode()


_RGB = [f"property uchar {name}" for name in ("red", "green", "blue")]
_FLOATS = [f"property float {name}" for name in ("red", "green", "blue")]

_GAUSSIANS: dict[str, tuple[bytes, str]] = {
    "empty file": (b"", "header: does not begin"),
    "another kind of file": (b"\x89PNG\r\n\x1a\n" + bytes(99), "header: does not begin"),
    "first line in capitals": (ply(first="PLY"), "header: does not begin"),
    "header without an end": (ply(end=""), "no line `end_header`"),
    "header of a mebibyte": (ply(more="comment " + "x" * 2**20), "no line `end_header` in its first"),
    "format unknown": (ply(form="format binary_middle_endian 1.0"), "header: has a line that is not understood"),
    "format missing": (ply(form=""), "header: has a line that is not understood there: 'element"),
    "format named twice": (ply(more="format ascii 1.0"), "header: has a line that is not understood"),
    "count negative": (ply(count=-1), "not understood there: 'element vertex"),
    "count in Arabic digits": (ply(count="٢"), "not understood there: 'element vertex"),
    "count of 18 digits": (ply(count=10**18 - 1), "element vertex: has a count of"),
    "count of 5,000 digits": (ply(count="1" * 5000), "not understood there: 'element vertex"),
    "one vertex too many in the header": (ply(count=3), "needs 168 bytes, but 112 follow"),
    "one vertex too few in the header": (ply(count=1), "needs 56 bytes, but 112 follow"),
    "last byte cut": (ply()[:-1], "needs 112 bytes, but 111 follow"),
    "bytes left over": (ply() + b"\0" * 7, "needs 112 bytes, but 119 follow"),
    "no vertex element": (ply().replace(b"element vertex", b"element thing"), "not understood there: 'property"),
    "vertices without properties": (ply(rows={}), "element vertex: is missing or has no properties"),
    "two vertex elements": (ply(more="element vertex 2"), "header: has a line that is not understood"),
    "property twice": (ply(more="property float x"), "header: has a line that is not understood"),
    "property of an unknown type": (ply(more="property quad w"), "header: has a line that is not understood"),
    "property before any element": (
        f"ply\n{_BINARY}\nproperty float x\nend_header\n".encode(), "header: has a line that is not understood",
    ),
    "list among the vertices": (ply(more="property list uchar int i"), "header: has a line that is not understood"),
    "list before the vertices": (
        ply(form=f"{_BINARY}\nelement face 1\nproperty list uchar int i"), "not understood there: 'property list",
    ),
    "SuperSplat's compressed": (
        f"ply\n{_BINARY}\nelement chunk 1\nproperty float min_x\nelement vertex 1\nproperty uint packed_position\nend_header\n"
        .encode(), "format: is SuperSplat's compressed PLY.*splat-transform a.ply a-plain.ply",
    ),
    "one f_rest": (ply(rows={**_GOOD, "f_rest_0": 0.0}), "f_rest: has 1 properties"),
    "f_rest with a gap": (ply(rows=_GOOD | {f"f_rest_{i + (i > 4)}": 0.0 for i in range(9)}), "f_rest_5: is missing"),
    **{f"{name} missing": (ply(rows=_without(name)), f"{name}: is missing from the vertices") for name in NAMES},
    **{f"{name} is NaN": (ply(rows={**_GOOD, name: float("nan")}), f"{name}: is not finite in vertex 0") for name in NAMES},
    **{f"{name} is infinite": (ply(rows={**_GOOD, name: float("inf")}), f"{name}: is not finite")
       for name in NAMES if name != "opacity"},
}  # fmt: skip
_POINTS: dict[str, tuple[bytes, str]] = {
    "word for a number": (_text("0 0 here"), "element vertex: cannot be read .*'here' to float32"),
    "a value missing": (_text("0 0"), "requires 3 columns but 2 were found"),
    "a row missing": (_text(""), "needs 1 rows, but 0 follow"),
    "a row too many": (_text("0 0 0\n0 0 0"), "needs 1 rows, but 2 follow"),
    "position of 1e99": (_text("0 0 1e99"), "z: is not finite in vertex 0"),
    "position is nan": (_text("nan 0 0"), "x: is not finite in vertex 0"),
    "colour of 256": (_text("0 0 0 1 2 256", *_RGB), "'256' to uint8"),
    "colour with a fraction": (_text("0 0 0 1 2.5 5", *_RGB), "'2.5' to uint8"),
    "float colour of 255": (_text("0 0 0 255 0 0", *_FLOATS), r"red, green, blue: must lie in \[0, 1\]"),
    "colours of two types": (_text("0 0 0 1 0 0", _RGB[0], *_FLOATS[1:]), "red, green, blue: must be all uchar"),
    "colour without blue": (_text("0 0 0 1 0", *_RGB[:2]), "blue: is missing"),
}
INPUTS = [
    BadInput("PLY", name, at("a.ply", read, content), pattern)
    for read, cases in ((read_gaussians, _GAUSSIANS), (read_points, _POINTS))
    for name, (content, pattern) in cases.items()
]
