"""Where I_HR comes from: super-resolution priors behind one call, cached by content.

A prior maps an LR photo to a reference `factor` times as large. Only `Images` needs files made elsewhere; `Onnx` and
`DnnSuperres` run networks on the CPU through OpenCV; `Bicubic` adds nothing and says so.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.photo_files import SUFFIXES, image_size, list_images, read_image, write_png
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_LARGEST_NETWORK: Final = 2 << 30  # bytes; protobuf's own limit
_NO_IMAGE: Final = 1e6  # values that neither a [0, 1] nor a 0…255 network makes
_EXPECTED_DISAGREEMENT: Final = 0.03  # mean |D(SR) - LR|: bicubic and the small networks stay near 0.01 on real photos
# A file of weights beside the model is named by a protobuf entry with the key "location" (field 1, length 8, also with
# needlessly long numbers). OpenCV would open whatever path stands there.
_EXTERNAL_DATA: Final = re.compile(rb"(?:\x0a|\x8a\x80*\x00)(?:\x08|\x88\x80*\x00)location")
_SECONDS_BETWEEN_REPORTS: Final = 10.0


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


@runtime_checkable
class Network(Prior, Protocol):
    """A prior that follows from the LR image, the bytes of `files` and its own fields: it can be cached."""

    @property
    def files(self) -> tuple[Path, ...]: ...


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
        result = images.quantize(read_image(file))
        _warn_if_it_disagrees(file.name, result, lr, factor)
        return result

    def _file(self, name: str) -> Path:
        folder, stem = Path(self.path), Path(name).stem + self.suffix
        found = [file for file in list_images(folder) if file.stem == stem]
        if not found:
            raise DataError(
                folder, Path(name).stem, f"has no SR image {stem} ({', '.join(SUFFIXES)})",
                "name the SR images like the views, or set prior.suffix",
            )  # fmt: skip
        if len(found) > 1:
            twins = " and ".join(file.name for file in found)
            raise DataError(folder, Path(name).stem, f"has {twins} for one view", "keep one of them")
        return found[0]


@dataclass(frozen=True, slots=True)
class Onnx:
    """Any image-to-image network in ONNX, run by OpenCV: RGB in [0, 1], [1, 3, h, w] -> [1, 3, factor·h, factor·w].

    Args:
        path: the .onnx file. tile: larger images are cut into tiles of this edge, LR px. overlap: see `tiled`, LR px.

    Raises:
        ValueError: the tiles would be all overlap.
    """

    path: str
    tile: int = 192
    overlap: int = 16

    def __post_init__(self) -> None:
        _require_tiles(self.tile, self.overlap)

    @property
    def label(self) -> str:
        return f"onnx {Path(self.path).name}"

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.path),)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        began = time.perf_counter()
        network = _read_onnx(Path(self.path))
        result = tiled(lambda part: self._run(network, part, factor), lr.cpu(), factor, self.tile, self.overlap)
        _log_result(name, self.label, result, began)
        result = images.quantize(result).to(lr.device)
        _warn_if_it_disagrees(self.label, result, lr, factor)
        return result

    def _run(self, network: Any, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        import cv2

        height, width = lr.shape[:2]
        try:
            network.setInput(lr.permute(2, 0, 1)[None].float().contiguous().numpy())
            out = np.asarray(network.forward())
        except cv2.error as error:
            problem = f"cannot run on {width}x{height} ({error.err})"
            raise DataError(
                self.path, "network", problem, "export it for RGB images [1, 3, h, w] of any size"
            ) from error
        expected = (1, 3, height * factor, width * factor)
        if out.shape != expected:
            problem = f"has shape {out.shape} where {expected} is expected"
            raise DataError(self.path, "output", problem, f"use a x{factor} network for RGB images of any size")
        if not (np.abs(out) < _NO_IMAGE).all():  # OpenCV turns NaN into the largest float; NaN itself fails this too
            raise DataError(self.path, "output", "is not finite", "check the network's weights")
        return torch.from_numpy(out[0].copy()).permute(1, 2, 0)  # a copy: the network owns `out` and writes there again


@dataclass(frozen=True, slots=True)
class DnnSuperres:
    """A model of OpenCV contrib's dnn_superres: 8-bit, whole image.

    Args:
        path: the .pb file. model: its kind: edsr, espcn, fsrcnn or lapsrn.

    Raises:
        ValueError: another kind.
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
        began = time.perf_counter()
        _require_file(Path(self.path), "the model, a .pb file")
        small = (images.quantize(lr) * 255).byte().cpu().numpy()
        command = [sys.executable, "-c", _SUPERRES, str(Path(self.path).absolute()), self.model, str(factor)]
        shape = np.array(small.shape[:2], "<i8").tobytes()
        child = subprocess.run(command, input=shape + small.tobytes(), capture_output=True, check=False)  # noqa: S603
        height, width = small.shape[0] * factor, small.shape[1] * factor
        if child.returncode:
            said = child.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {child.returncode}"]
            reason = next((line for line in said if "Error" in line or "error" in line), said[-1])
            raise DataError(
                self.path, "network", f"cannot be run as {self.model} x{factor} ({reason})",
                "set prior.model to the model's kind; dnn_superres needs opencv-contrib-python-headless",
            )  # fmt: skip
        if len(child.stdout) != height * width * 3:
            problem = f"does not enlarge {small.shape[1]}x{small.shape[0]} to {width}x{height}"
            raise DataError(self.path, "network", problem, f"use a x{factor} model")
        large = np.frombuffer(child.stdout, np.uint8).reshape(height, width, 3).copy()
        result = torch.from_numpy(large).to(lr) / 255
        _log_result(name, self.label, result, began)
        _warn_if_it_disagrees(self.label, result, lr, factor)
        return result


# dnn_superres replaces OpenCV's DepthToSpace layer for good, and every ONNX network read after that in the same
# process shuffles its pixels wrongly without a word; hence a process of its own. Raw RGB goes in and comes out.
_SUPERRES: Final = """
import sys, numpy, cv2
_, path, kind, factor = sys.argv
data = sys.stdin.buffer.read()
height, width = numpy.frombuffer(data[:16], "<i8")
rgb = numpy.frombuffer(data[16:], numpy.uint8).reshape(height, width, 3)
network = cv2.dnn_superres.DnnSuperResImpl_create()
network.readModel(path)
network.setModel(kind, int(factor))
bgr = network.upsample(numpy.ascontiguousarray(rgb[..., ::-1]))
sys.stdout.buffer.write(numpy.ascontiguousarray(bgr[..., ::-1]).tobytes())
"""


@dataclass(frozen=True, slots=True)
class Cached:
    """A network, remembered by content: the LR image, the factor, the model's bytes and its settings.

    Args:
        folder: where results stay, as PNG; the default is ~/.cache/clear-strategies/sr, or $CLEAR_CACHE/sr.
    """

    prior: Network
    folder: Path = field(default_factory=lambda: cache_folder() / "sr")

    @property
    def label(self) -> str:
        return self.prior.label

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        file = self.folder / f"{self._key(lr, factor)}.png"
        if file.exists():
            try:
                result = read_image(file, expect=(lr.shape[1] * factor, lr.shape[0] * factor)).to(lr)
            except DataError as damaged:
                _log.warning("a cached SR image is damaged and is made again: %s", damaged)
            else:
                _log.info("%s: SR image from the cache (%s).", name, self.label)
                return result
        result = images.quantize(self.prior(name, lr, factor))
        try:
            write_png(file, result)
        except OSError as error:  # a cache that cannot be written is slow, not wrong
            _log.warning("the SR image of %s cannot be cached in %s (%s).", name, self.folder, error.strerror)
        return result

    def _key(self, lr: Float[Tensor, "h w 3"], factor: int) -> str:
        """The model's place on the disk is no part of it: a moved or linked model is the same model."""
        settings = {f.name: getattr(self.prior, f.name) for f in fields(self.prior) if f.compare and f.name != "path"}  # type: ignore[arg-type]
        identity = (type(self.prior).__name__, settings, factor, tuple(lr.shape), str(lr.dtype))
        digest = hashlib.sha256(repr(identity).encode())
        digest.update(lr.cpu().contiguous().numpy().tobytes())
        for file in self.prior.files:
            _require_file(file, "the model")
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()


def cached(prior: Prior) -> Prior:
    """The prior, remembered where it can be: a network depends on nothing but its input and its files."""
    return Cached(prior) if isinstance(prior, Network) else prior


def cache_folder() -> Path:
    """Where results that can be made again are kept: $CLEAR_CACHE, else ~/.cache/clear-strategies."""
    return Path(os.environ.get("CLEAR_CACHE") or Path.home() / ".cache" / "clear-strategies").expanduser()


def tiled(
    upscale: Callable[[Float[Tensor, "h w 3"]], Float[Tensor, "H W 3"]],
    lr: Float[Tensor, "h w 3"],
    factor: int,
    tile: int,
    overlap: int,
) -> Float[Tensor, "H W 3"]:
    """Apply `upscale` to tiles of at most `tile` × `tile` LR pixels, and join the results without seams.

    A tile contributes `overlap` LR pixels more than its share on each side, faded into its neighbour, and sees as many
    again: the result is that of the whole image where `overlap` reaches as far as the network sees, and has no edges
    where the network sees everything (global pooling).

    Raises:
        ValueError: the tiles would be all overlap.
    """
    _require_tiles(tile, overlap)
    height, width = lr.shape[:2]
    if max(height, width) <= tile:
        return upscale(lr)
    rows, columns = (_cuts(size, tile, overlap) for size in (height, width))
    out = lr.new_zeros(height * factor, width * factor, 3)
    weight = lr.new_zeros(height * factor, width * factor, 1)
    total, began = len(rows) * len(columns), time.perf_counter()
    for done, (row, column) in enumerate((r, c) for r in rows for c in columns):
        seen = tuple(
            slice(max(a - 2 * overlap, 0), min(b + 2 * overlap, size))
            for (a, b), size in ((row, height), (column, width))
        )
        fade_y, fade_x = (
            _fade(core, part, size, factor, overlap).to(lr)
            for core, part, size in ((row, seen[0], height), (column, seen[1], width))
        )
        fade = (fade_y[:, None] * fade_x)[..., None]
        there = tuple(slice(part.start * factor, part.stop * factor) for part in seen)
        out[there] += fade * upscale(lr[seen])
        weight[there] += fade
        if time.perf_counter() - began > _SECONDS_BETWEEN_REPORTS:
            _log.info("super-resolution: %d of %d tiles.", done + 1, total)
            began = time.perf_counter()
    return out / weight


def _cuts(size: int, tile: int, overlap: int) -> list[tuple[int, int]]:
    """[0, size) in near-equal pieces that leave room for what a tile sees on both sides."""
    count = math.ceil(size / (tile - 4 * overlap)) if size > tile else 1
    ends = [size * i // count for i in range(count + 1)]
    return list(itertools.pairwise(ends))


def _fade(core: tuple[int, int], seen: slice, size: int, factor: int, overlap: int) -> Float[Tensor, " n"]:
    """Weight of a tile along one axis, per HR pixel: 1 inside, a ramp over 2 `overlap` around each inner border, then 0."""
    at = torch.arange(seen.start * factor, seen.stop * factor) + 0.5
    ramp = max(2 * overlap * factor, 1)  # without overlap: a sharp cut between two pixels
    weight = torch.ones_like(at)
    if core[0] > 0:
        weight = weight * ((at - core[0] * factor) / ramp + 0.5).clamp(0, 1)
    if core[1] < size:
        weight = weight * ((core[1] * factor - at) / ramp + 0.5).clamp(0, 1)
    return weight


def _require_tiles(tile: int, overlap: int) -> None:
    if not 0 <= 4 * overlap < tile:
        raise ValueError(f"0 <= 4 overlap < tile must hold, got overlap={overlap}, tile={tile}.")


def _read_onnx(path: Path) -> Any:
    import cv2

    _require_file(path, "a network in ONNX")
    if path.stat().st_size > _LARGEST_NETWORK:
        raise DataError(path, "size", "is more than 2 GiB, which no ONNX file is", "check the path")
    data = path.read_bytes()
    if _EXTERNAL_DATA.search(data):
        raise DataError(
            path, "weights", "lie in other files (ONNX external data)", "save the model with its weights inside"
        )
    try:
        return cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
    except cv2.error as error:
        problem = f"is no ONNX network that OpenCV can read ({error.err})"
        raise DataError(path, "network", problem, "export it as ONNX, opset 11 to 17, weights inside") from error


def _require_file(path: Path, what: str) -> None:
    if not path.is_file():
        raise DataError(path, "file", "is not there", f"set prior.path to {what}")
    if not os.access(path, os.R_OK):
        raise DataError(path, "file", "cannot be read", "check its permissions")


def _warn_if_it_disagrees(what: str, sr: Float[Tensor, "H W 3"], lr: Float[Tensor, "h w 3"], factor: int) -> None:
    """A network for BGR or for 0…255 and pictures of other views look like super-resolution, but not of this image."""
    distance = float((images.downsample(sr, factor, "area") - lr).abs().mean())
    if distance > _EXPECTED_DISAGREEMENT:
        _log.warning(
            "%s: reduced again, the SR image is %.3f away from its LR image on average (usual: below %.2f); check that "
            "it is of this view, RGB and in [0, 1].", what, distance, _EXPECTED_DISAGREEMENT,
        )  # fmt: skip


def _log_result(name: str, label: str, result: Float[Tensor, "H W 3"], began: float) -> None:
    seconds = time.perf_counter() - began
    _log.info("%s: %s made %dx%d in %.1f s.", name, label, result.shape[1], result.shape[0], seconds)
