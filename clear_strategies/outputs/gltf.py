"""A splat as binary glTF 2.0 with Khronos' extension KHR_gaussian_splatting: what glTF viewers, engines and 3D Tiles read.

Attributes are activated: scales linear, opacities in [0, 1], unit quaternions (x, y, z, w). A viewer without the extension
draws the points in COLOR_0.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float

from clear_strategies.data.ply import GaussianPly
from rasterizers.geometry import SH_C0

_EXTENSION: Final = "KHR_gaussian_splatting"
_FLOAT: Final = 5126  # glTF's componentType
_VERTICES: Final = 34962  # glTF's bufferView.target
_POINTS: Final = 0  # glTF's primitive.mode
_TYPES: Final = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
# y points down in 3DGS files and up in glTF: half a turn around x, of the node, so that the Gaussians stay as they are.
_HALF_TURN: Final = [1.0, 0.0, 0.0, 0.0]


def glb_bytes(g: GaussianPly) -> bytes:
    """The .glb file: a node with one primitive of points, all of its attributes float32."""
    attributes = _attributes(g)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for name, values in attributes.items():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": _VERTICES})
        width = 1 if values.ndim == 1 else values.shape[1]
        accessor = {"bufferView": len(accessors), "componentType": _FLOAT, "count": len(values), "type": _TYPES[width]}
        if name == "POSITION":  # glTF demands its bounds
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
        offset += values.nbytes
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "mode": _POINTS,
        "attributes": {name: k for k, name in enumerate(attributes)},
        "extensions": {_EXTENSION: splats},
    }
    content = {
        "asset": {"version": "2.0", "generator": "clear-strategies"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _HALF_TURN}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    return _container(content, b"".join(values.tobytes() for values in attributes.values()))


def _attributes(g: GaussianPly) -> dict[str, Float[np.ndarray, "N ..."]]:
    quats = torch.nn.functional.normalize(g.quats, dim=1)
    opacities = g.opacities.sigmoid()
    rgba = torch.cat(((g.sh0[:, 0] * SH_C0 + 0.5).clamp(0, 1), opacities[:, None]), dim=1)
    named = {
        "POSITION": g.means,
        "COLOR_0": rgba,
        f"{_EXTENSION}:ROTATION": quats.roll(-1, dims=1),
        f"{_EXTENSION}:SCALE": g.scales.exp(),
        f"{_EXTENSION}:OPACITY": opacities,
        f"{_EXTENSION}:SH_DEGREE_0_COEF_0": g.sh0[:, 0],
    }
    for k in range(g.shN.shape[1]):  # band d has 2d + 1 coefficients, and d² precede it
        degree = int((k + 1) ** 0.5)
        named[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{k + 1 - degree**2}"] = g.shN[:, k]
    return {name: values.detach().float().cpu().contiguous().numpy().astype("<f4") for name, values in named.items()}


def _container(content: Mapping[str, Any], buffer: bytes) -> bytes:
    """GLB: a header, then JSON and buffer as chunks of whole words."""
    text = json.dumps(content, separators=(",", ":")).encode()
    chunks = b""
    for kind, padding, data in ((b"JSON", b" ", text), (b"BIN\0", b"\0", buffer)):
        whole = data + padding * (-len(data) % 4)
        chunks += struct.pack("<I4s", len(whole), kind) + whole
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
