"""Where I_HR comes from: super-resolution priors behind one call, cached by content.

A prior maps an LR photo to a reference `factor` times as large. Only `Images` needs files made elsewhere; `Onnx` and
`DnnSuperres` run networks on the CPU through OpenCV; `Bicubic` adds nothing and says so.
"""

from __future__ import annotations

import hashlib
import logging
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import images
from clear_strategies.data.photo_files import SUFFIXES, image_size, list_images, read_image, write_png
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)


@runtime_checkable
class Prior(Protocol):
    """A frozen image super-resolution model."""

    @property
    def label(self) -> str:
        """One phrase for the plan and the tables."""
        ...

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        """I_HR of the view called `name`; values in [0, 1] on 8-bit steps."""
        ...


@dataclass(frozen=True, slots=True)
class Bicubic:
    """U(I_LR): no detail beyond LR; a stand-in where no network is at hand."""

    label: str = field(default="bicubic (no detail beyond LR)", init=False)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        return images.quantize(images.upsample(lr, factor))


@dataclass(frozen=True, slots=True)
class Images:
    """SR pictures made elsewhere (e.g. by ResShift), one a view: `<view's stem>[suffix].<png, jpg …>`.

    Args:
        path: their folder. suffix: what the SR tool appended to the file names, e.g. "_x4".
    """

    path: str
    suffix: str = ""

    @property
    def label(self) -> str:
        return f"images {self.path}"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        file = self._file(name)
        expected = (lr.shape[1] * factor, lr.shape[0] * factor)
        found = image_size(file)
        if found != expected:
            raise DataError(
                file, "size", f"is {found[0]}x{found[1]}, but {factor} times the LR image is {expected[0]}x{expected[1]}",
                "super-resolve the very LR images that this run trains on (data.save_lr writes them)",
            )  # fmt: skip
        return read_image(file)

    def _file(self, name: str) -> Path:
        folder, stem = Path(self.path), Path(name).stem
        for file in list_images(folder):
            if file.stem == stem + self.suffix:
                return file
        raise DataError(
            folder, stem, f"has no SR image {stem}{self.suffix} ({', '.join(SUFFIXES)})",
            "name the SR images like the views, or set prior.suffix",
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Onnx:
    """Any image-to-image network in ONNX, run by OpenCV: RGB in [0, 1], [1, 3, h, w] -> [1, 3, factor·h, factor·w].

    Args:
        path: the .onnx file. tile: larger images are cut into tiles of this edge, LR px. overlap: how far a tile looks
            beyond what is kept of it, LR px; at least the network's receptive field makes the seams vanish.
    """

    path: str
    tile: int = 192
    overlap: int = 16

    def __post_init__(self) -> None:
        if not 0 <= 2 * self.overlap < self.tile:
            raise ValueError(f"0 <= 2 overlap < tile must hold, got overlap={self.overlap}, tile={self.tile}.")

    @property
    def label(self) -> str:
        return f"onnx {Path(self.path).name}"

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.path),)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        network = _read_network(Path(self.path))
        began = time.perf_counter()
        result = tiled(lambda part: self._run(network, part, factor), lr, factor, self.tile, self.overlap)
        _log.info("%s: %s took %.1f s.", name, self.label, time.perf_counter() - began)
        return images.quantize(result)

    def _run(self, network: Any, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        import cv2

        network.setInput(np.ascontiguousarray(lr.permute(2, 0, 1).numpy()[None]))
        try:
            out = np.asarray(network.forward())
        except cv2.error as error:
            problem = f"cannot run on {lr.shape[1]}x{lr.shape[0]} ({error.err})"
            raise DataError(self.path, "network", problem, "export it with dynamic image sizes") from error
        expected = (1, 3, lr.shape[0] * factor, lr.shape[1] * factor)
        if out.shape != expected:
            raise DataError(
                self.path,
                "output",
                f"has shape {out.shape} where {expected} is expected",
                f"use a x{factor} RGB network",
            )
        return torch.from_numpy(out[0]).permute(1, 2, 0).clamp(0, 1)


@dataclass(frozen=True, slots=True)
class DnnSuperres:
    """A model of OpenCV contrib's dnn_superres: 8-bit, whole image.

    Args:
        path: the .pb file. model: its kind: edsr, espcn, fsrcnn or lapsrn.
    """

    path: str
    model: str = "espcn"

    def __post_init__(self) -> None:
        if self.model not in ("edsr", "espcn", "fsrcnn", "lapsrn"):
            raise ValueError(f"model must be edsr, espcn, fsrcnn or lapsrn, got {self.model!r}.")

    @property
    def label(self) -> str:
        return f"dnn_superres {Path(self.path).name}"

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.path),)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        import cv2

        if not Path(self.path).is_file():
            raise DataError(self.path, "file", "is not there", "set prior.path to the model")
        network = cv2.dnn_superres.DnnSuperResImpl_create()  # type: ignore[attr-defined]
        try:
            network.readModel(self.path)
            network.setModel(self.model, factor)
            bgr = (images.quantize(lr) * 255).round().to(torch.uint8).numpy()[..., ::-1]
            out = network.upsample(np.ascontiguousarray(bgr))
        except cv2.error as error:
            problem = f"cannot be run as {self.model} x{factor} ({error.err})"
            raise DataError(self.path, "network", problem, "set prior.model to the model's kind") from error
        if out.shape[:2] != (lr.shape[0] * factor, lr.shape[1] * factor):
            problem = f"enlarges {lr.shape[1]}x{lr.shape[0]} to {out.shape[1]}x{out.shape[0]}"
            raise DataError(self.path, "network", problem, f"use a x{factor} model")
        _log.info("%s: %s.", name, self.label)
        return torch.from_numpy(np.ascontiguousarray(out[..., ::-1])).float() / 255


@dataclass(frozen=True, slots=True)
class Cached:
    """Another prior, remembered by content: the LR image, the factor, the model's bytes and its settings.

    Args:
        folder: where results stay, as PNG; the default is ~/.cache/clear-strategies/sr, or $CLEAR_CACHE/sr.
    """

    prior: Any
    folder: Path = field(default_factory=lambda: cache_folder() / "sr")

    @property
    def label(self) -> str:
        return str(self.prior.label)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        file = self.folder / f"{self._key(lr, factor)}.png"
        size = (lr.shape[1] * factor, lr.shape[0] * factor)
        if file.exists():
            try:
                result = read_image(file, expect=size)
            except DataError as damaged:
                _log.warning("a cached SR image is damaged and is made again: %s", damaged)
            else:
                _log.info("%s: SR image from the cache (%s).", name, self.label)
                return result
        result = self.prior(name, lr, factor)
        write_png(file, result)
        return images.quantize(result)

    def _key(self, lr: Float[Tensor, "h w 3"], factor: int) -> str:
        digest = hashlib.sha256(repr((self.prior, factor, tuple(lr.shape))).encode())
        digest.update(np.ascontiguousarray(lr.numpy()).tobytes())
        for file in self.prior.files:
            try:
                digest.update(file.read_bytes())
            except OSError as error:
                raise DataError(
                    file, "file", f"cannot be read ({error.strerror})", "set prior.path to the model"
                ) from error
        return digest.hexdigest()


def cache_folder() -> Path:
    """Where results that can be made again are kept: $CLEAR_CACHE, else ~/.cache/clear-strategies."""
    return Path(os.environ.get("CLEAR_CACHE") or Path.home() / ".cache" / "clear-strategies")


def tiled(upscale: Any, lr: Float[Tensor, "h w 3"], factor: int, tile: int, overlap: int) -> Float[Tensor, "H W 3"]:
    """Apply `upscale` tile by tile, each seeing `overlap` more pixels on every side than are kept of it."""
    height, width = lr.shape[:2]
    if max(height, width) <= tile:
        result: Tensor = upscale(lr)
        return result
    out = lr.new_empty(height * factor, width * factor, 3)
    step = tile - 2 * overlap
    for top in range(0, height, step):
        for left in range(0, width, step):
            bottom, right = min(top + step, height), min(left + step, width)
            y, x = max(top - overlap, 0), max(left - overlap, 0)
            part = upscale(lr[y : bottom + overlap, x : right + overlap])
            out[top * factor : bottom * factor, left * factor : right * factor] = part[
                (top - y) * factor : (bottom - y) * factor, (left - x) * factor : (right - x) * factor
            ]
    return out


_LARGEST_NETWORK: Final = 2 << 30  # protobuf's own limit


def _read_network(path: Path) -> Any:
    import cv2

    if not path.is_file():
        raise DataError(path, "file", "is not there", "set prior.path to a x4 network in ONNX")
    if path.stat().st_size > _LARGEST_NETWORK:
        raise DataError(path, "size", "is more than 2 GiB, which no ONNX file is", "check the path")
    try:
        return cv2.dnn.readNetFromONNX(
            np.frombuffer(path.read_bytes(), np.uint8)
        )  # bytes: no external data is followed
    except cv2.error as error:
        problem = f"is no ONNX network that OpenCV can read ({error.err})"
        raise DataError(path, "network", problem, "export it as ONNX, opset 11 to 17") from error
