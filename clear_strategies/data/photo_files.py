"""The one image reader: what cannot be read exactly is refused, with what to do about it.

The kind of file is decided by its content; a truncated file is an error and not a picture with a grey bottom; 16 bits
stay 16 bits; alpha is composited by a stated rule; a photo that must be turned is refused, for readers disagree on it.
"""

from __future__ import annotations

import io
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from clear_strategies.errors import DataError
from clear_strategies.files import write_bytes

_log = logging.getLogger(__name__)

SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
_FORMATS: Final = ("PNG", "JPEG", "WEBP", "TIFF")
_MAX_PIXELS: Final = 100_000_000
_EXIF_ORIENTATION: Final = 0x0112


def read_image(
    path: Path,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    expect: tuple[int, int] | None = None,
    max_pixels: int = _MAX_PIXELS,
) -> Float[Tensor, "H W 3"]:
    """RGB in [0, 1], float32.

    Args:
        background: what shows through where the image has (straight) alpha. expect: (width, height) it must have.

    Raises:
        DataError: not a PNG, JPEG, WebP or TIFF, damaged, too large, turned by EXIF, or of another size.
    """
    with _opened(path, max_pixels) as image:
        if expect is not None and image.size != expect:
            raise DataError(
                path, "size", f"is {image.width}x{image.height} where {expect[0]}x{expect[1]} is expected",
                "use images of the size the cameras were made for",
            )  # fmt: skip
        try:
            image.load()
        except (OSError, SyntaxError, ValueError) as error:
            raise DataError(path, "pixels", f"cannot be decoded ({error})", "replace the damaged file") from error
        pixels = _to_float(path, image)
    rgb, alpha = pixels[..., :3], pixels[..., 3:]
    if alpha.shape[2]:
        rgb = rgb * alpha + np.asarray(background, np.float32) * (1 - alpha)
    return torch.from_numpy(np.ascontiguousarray(rgb))


def image_size(path: Path, *, max_pixels: int = _MAX_PIXELS) -> tuple[int, int]:
    """(width, height), from the header only."""
    with _opened(path, max_pixels) as image:
        return image.size


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder by name, decided by suffix; anything else is not looked at.

    Raises:
        DataError: the folder is not there, or holds no image.
    """
    if not folder.is_dir():
        raise DataError(folder, "folder", "is not there", "check the path")
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    if not found:
        raise DataError(folder, "images", f"holds no image ({', '.join(SUFFIXES)})", "check the path")
    return found


def write_png(path: Path, image: Float[Tensor, "H W 3"]) -> None:
    """8-bit PNG, atomically; values outside [0, 1] are clamped."""
    pixels = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    write_bytes(path, buffer.getvalue())


def inside(root: Path, name: str, *, file: Path) -> Path:
    """`root / name`, if that is inside `root` after symbolic links are followed.

    Args:
        file: where the name was read, for the message.

    Raises:
        DataError: the name is absolute or leads out of `root`.
    """
    if not name or "\0" in name:
        raise DataError(file, "file name", f"{name!r} is no file name", "name an image inside the data set's folder")
    target = (root / name).resolve()
    if os.path.isabs(name) or not target.is_relative_to(root.resolve()):  # noqa: PTH117 - also "C:\\" on Windows
        raise DataError(
            file, "file name", f"{name!r} leads out of {root}", "keep the images inside the data set's folder"
        )
    return target


@contextmanager
def _opened(path: Path, max_pixels: int) -> Iterator[Image.Image]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own limit follows
            image = Image.open(path, formats=_FORMATS)
    except FileNotFoundError as error:
        raise DataError(path, "file", "is not there", "check the path") from error
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise DataError(
            path, "file", f"is no readable image ({type(error).__name__})", f"use one of {', '.join(_FORMATS)}"
        ) from error
    with image:
        if image.width * image.height > max_pixels:
            raise DataError(
                path, "size", f"{image.width}x{image.height} is more than {max_pixels:,} pixels",
                "downsample the images before training",
            )  # fmt: skip
        try:
            orientation = image.getexif().get(_EXIF_ORIENTATION, 1)
        except (OSError, SyntaxError, ValueError, KeyError):
            orientation = 1  # an unreadable EXIF block turns nothing
        if orientation not in (0, 1):
            raise DataError(
                path, "EXIF orientation", f"is {orientation}: the photo is stored turned, and its camera may not be",
                "turn the pixels first (e.g. with `mogrify -auto-orient`), then estimate poses from the result",
            )  # fmt: skip
        yield image


def _to_float(path: Path, image: Image.Image) -> Float[np.ndarray, "H W C"]:
    """[H, W, 3 or 4] in [0, 1]."""
    if image.mode in ("I;16", "I;16B", "I;16L", "I"):
        grey = np.asarray(image, np.float32) / 65535
        return np.repeat(grey[..., None], 3, axis=2)
    if image.format in ("PNG", "TIFF") and _bits_per_channel(image) == 16:
        return _read_sixteen_bits(path)
    if image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        raise DataError(path, "colour mode", f"is {image.mode}", "convert the image to RGB")
    has_alpha = image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if has_alpha else "RGB"), np.float32) / 255


def _bits_per_channel(image: Image.Image) -> int:
    if image.format == "PNG":
        mode = image.tile[0][3] if image.tile else ""
        return 16 if isinstance(mode, str) and ";16" in mode else 8
    bits = getattr(image, "tag_v2", {}).get(258, (8,))
    return int(max(bits)) if isinstance(bits, tuple) else int(bits)


def _read_sixteen_bits(path: Path) -> Float[np.ndarray, "H W C"]:
    """PIL keeps only the upper 8 bits of 16-bit colour; OpenCV keeps all."""
    import cv2

    data = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if data is None or data.dtype != np.uint16 or data.ndim != 3 or data.shape[2] not in (3, 4):
        raise DataError(path, "pixels", "are 16-bit in a layout that is not known", "convert the image to 8-bit RGB")
    order = [2, 1, 0] if data.shape[2] == 3 else [2, 1, 0, 3]
    return data[..., order].astype(np.float32) / 65535
