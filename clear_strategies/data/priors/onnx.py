"""A super-resolution network in ONNX, run on the CPU by OpenCV."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.priors.interface import checked_sr, require_path
from clear_strategies.data.priors.tiling import require_tiles, tiled
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes

_LARGEST_FILE: Final = 2 << 30  # bytes; protobuf's own limit
_LARGEST_VALUE: Final = 1e6  # neither a [0, 1] nor a [0, 255] network gives more
# A protobuf entry with the key "location" (field 1, length 8, in any valid encoding of these numbers) names a file of
# weights beside the model. OpenCV would open any path named there.
_EXTERNAL_DATA: Final = re.compile(rb"(?:\x0a|\x8a\x80*\x00)(?:\x08|\x88\x80*\x00)location")


@dataclass(frozen=True, slots=True)
class Onnx:
    """Any network from RGB in [0, 1], [1, 3, h, w], to [1, 3, factor·h, factor·w].

    Args:
        path: the .onnx file.
        tile: edge of the tiles into which larger images are cut, LR px.
        overlap: see `tiling.tiled`, LR px.

    Raises:
        SettingError: no path is given, or the tiles would be all overlap.
    """

    path: str = ""
    tile: int = 192
    overlap: int = 16
    version: str = field(init=False)  # of OpenCV; part of the cache's key, since another version may round differently

    def __post_init__(self) -> None:
        require_path(self.path, "a network in ONNX")
        require_tiles(self.tile, self.overlap)
        import cv2

        object.__setattr__(self, "version", cv2.__version__)

    @property
    def label(self) -> str:
        return f"onnx {Path(self.path).name}"

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.path),)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        network = _read_network(Path(self.path))
        large = tiled(lambda part: self._run(network, part, factor), lr.cpu(), factor, self.tile, self.overlap)
        return checked_sr(self.label, large, lr, factor)

    def _run(self, network: Any, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        import cv2

        height, width = lr.shape[:2]
        try:
            network.setInput(lr.permute(2, 0, 1)[None].float().contiguous().numpy())
            out = np.asarray(network.forward())
        except cv2.error as error:
            problem = f"cannot run on {width}x{height} in OpenCV {cv2.__version__} ({error.err})"
            remedy = "export it for RGB images of any size, and install OpenCV 4.11 or later"
            raise DataError(self.path, "network", problem, remedy) from error
        expected = (1, 3, height * factor, width * factor)
        if out.shape != expected:
            problem = f"has shape {out.shape} where {expected} is expected"
            raise DataError(self.path, "output", problem, f"use a x{factor} network for RGB images of any size")
        if not (np.abs(out) < _LARGEST_VALUE).all():  # OpenCV turns NaN into the largest float; NaN itself fails too
            raise DataError(self.path, "output", "is not finite", "check the network's weights")
        return torch.from_numpy(out[0].copy()).permute(1, 2, 0)  # a copy: the network writes to `out` again


def _read_network(path: Path) -> Any:
    import cv2

    data = read_bytes(path, most=_LARGEST_FILE, remedy="set prior.path to a network in ONNX")
    if _EXTERNAL_DATA.search(data):
        problem = "lie in other files (ONNX external data)"
        raise DataError(path, "weights", problem, "save the model with its weights inside")
    try:
        return cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
    except cv2.error as error:
        problem = f"is no ONNX network that OpenCV can read ({error.err})"
        raise DataError(path, "network", problem, "export it as ONNX, opset 11 to 17, weights inside") from error
