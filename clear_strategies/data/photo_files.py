"""Image files, read and written. What cannot be read exactly is refused, with a remedy.

The content of a file decides its kind. A truncated file is an error, not an image with a grey bottom. 16 bits stay 16
bits. Alpha is composited over a stated background. A photo with an EXIF rotation is refused, because programs disagree
on whether the camera's pose includes it.
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
from PIL import Image
from torch import Tensor

from clear_strategies.errors import DataError
from clear_strategies.files import require_regular, write_bytes

_log = logging.getLogger(__name__)

SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
_FORMATS: Final = ("PNG", "JPEG", "WEBP", "TIFF")
_MAX_PIXELS: Final = 100_000_000
_FOLDERS: Final = ("images", "images_2", "images_4", "images_8")
_LONGEST_NAME: Final = 1024
_LARGE: Final = 1 << 24  # pixels; smaller images may be drawings, which compress without limit
_BOMB: Final = 200
_EXIF_ORIENTATION: Final = 0x0112


def read_image(
    path: Path,
    *,
    background: tuple[float, float, float] | None = None,
    expect: tuple[int, int] | None = None,
    max_pixels: int = _MAX_PIXELS,
) -> Float[Tensor, "H W 3"]:
    """RGB in [0, 1], float32.

    Args:
        background: RGB in [0, 1] behind (straight) alpha: rgb · alpha + background · (1 - alpha). None: black, logged.
        expect: (width, height) the image must have.
        max_pixels: a larger image is refused before it is decoded.

    Raises:
        DataError: the file is no PNG, JPEG, WebP or TIFF, is damaged or too large, or the image is rotated by EXIF, has
            an unknown colour mode, or has another size.
    """
    with _opened(path, max_pixels) as image:
        if expect is not None and image.size != expect:
            raise DataError(
                path,
                "size",
                f"is {image.width}x{image.height} where {expect[0]}x{expect[1]} is expected",
                "use images of the size the cameras were made for",
            )
        sixteen_bits = ";16" in str(getattr(image, "tile", ""))  # the layout in the file, unknown after decoding
        try:
            image.load()
        except Exception as error:  # PIL's decoders raise many types of error on damaged bytes
            raise DataError(path, "pixels", f"cannot be decoded ({error})", "replace the damaged file") from error
        _refuse_rotated(path, image)
        pixels = _to_float(path, image, sixteen_bits)
    rgb, alpha = pixels[..., :3], pixels[..., 3:]
    if alpha.size and alpha.min() < 1:
        if background is None:
            _log.info("%s has transparent pixels: composited over black.", path.name)
        rgb = rgb * alpha + np.asarray(background or (0, 0, 0), np.float32) * (1 - alpha)
    return torch.from_numpy(np.ascontiguousarray(rgb))


def image_size(path: Path, *, max_pixels: int = _MAX_PIXELS) -> tuple[int, int]:
    """(width, height), from the header only.

    Raises:
        DataError: as `read_image`, as far as the header tells.
    """
    with _opened(path, max_pixels) as image:
        return image.size


def image_folder(root: Path, name: str | None = None) -> Path:
    """The folder of photos in `root`; without a name, the first of images, images_2, images_4, images_8.

    Raises:
        DataError: it is not there.
    """
    present = [folder for folder in _FOLDERS if (root / folder).is_dir()]
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "check the path")
    if name is not None:
        if not (root / name).is_dir():
            there = f"choose one of {', '.join(present)}" if present else "check the path"
            raise DataError(root / name, "images", "is no folder", there)
        return root / name
    if not present:
        raise DataError(root, "images", f"has none of the folders {', '.join(_FOLDERS)}", "name the folder of photos")
    return root / present[0]


def folder_note(folder: Path) -> str:
    """The folder's name, and which others there are, for the plan."""
    others = [name for name in _FOLDERS if name != folder.name and (folder.parent / name).is_dir()]
    return f"{folder.name} (there are also {', '.join(others)})" if others else folder.name


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder, by their suffix, in order of names. Other files are ignored.

    Raises:
        DataError: the folder is not there, or holds no image.
    """
    if not folder.is_dir():
        raise DataError(folder, "folder", "is not there", "check the path")
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    if not found:
        raise DataError(folder, "images", f"holds no image ({', '.join(SUFFIXES)})", "check the path")
    return found


def write_png(path: Path, image: Float[Tensor, "H W 3"] | Float[Tensor, "H W"]) -> None:
    """8-bit PNG, written atomically; a [H, W] image is grey. Values outside [0, 1] are clamped."""
    pixels = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    write_bytes(path, buffer.getvalue())


def jpeg(image: Float[Tensor, "H W 3"], quality: int = 90) -> bytes:
    """A small file of an image in [0, 1], for display and not for measurements."""
    pixels = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()


def inside(root: Path, name: str, *, file: Path, allow_outside: bool = False) -> Path:
    """`root / name`, if that is inside `root` once symbolic links are resolved.

    Args:
        file: where the name was read, for the message.
        allow_outside: accept absolute names and links out of `root`, for trusted data sets.

    Raises:
        DataError: the name is absolute or leads out of `root`.
    """
    parts = name.replace("\\", "/").split("/")
    if not 0 < len(name) <= _LONGEST_NAME or "\0" in name or max(len(p.encode(errors="replace")) for p in parts) > 255:
        raise DataError(
            file, "file name", f"{name[:80]!r} is no file name", "name an image inside the data set's folder"
        )
    if allow_outside:
        return root / name
    try:
        within = not os.path.isabs(name) and (root / name).resolve().is_relative_to(root.resolve())  # noqa: PTH117
    except (OSError, RuntimeError, ValueError) as error:  # circular links, names that no system allows
        problem = f"{name[:80]!r} cannot be resolved ({type(error).__name__})"
        raise DataError(file, "file name", problem, "rename the file") from error
    if not within:
        raise DataError(
            file,
            "file name",
            f"{name!r} leads out of {root}",
            "keep the images inside the data set's folder, or allow files outside of it",
        )
    return root / name


@contextmanager
def _opened(path: Path, max_pixels: int) -> Iterator[Image.Image]:
    require_regular(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PIL's warnings: our own size limit follows, and damage fails on decoding
            image = Image.open(path, formats=_FORMATS)
    except FileNotFoundError as error:
        raise DataError(path, "file", "is not there", "check the path") from error
    except Exception as error:  # PIL raises many types of error on damaged headers
        raise DataError(
            path, "file", f"is no readable image ({type(error).__name__})", f"use one of {', '.join(_FORMATS)}"
        ) from error
    with image:
        if image.width * image.height > max_pixels:
            raise DataError(
                path,
                "size",
                f"{image.width}x{image.height} is more than {max_pixels:,} pixels",
                "downsample the images before training",
            )
        if image.width * image.height > _LARGE and image.width * image.height * 3 > _BOMB * path.stat().st_size:
            problem = f"{image.width}x{image.height} pixels are more than {_BOMB} times the file, as in no photo"
            raise DataError(path, "size", problem, "use the camera's own file")
        # A PNG may keep its EXIF block behind the pixels; `read_image` checks again after decoding them.
        if image.format != "PNG" or "exif" in image.info:
            _refuse_rotated(path, image)
        yield image


def _refuse_rotated(path: Path, image: Image.Image) -> None:
    try:
        orientation = image.getexif().get(_EXIF_ORIENTATION, 1)
    except Exception as error:  # as above
        _log.info("%s: its EXIF block cannot be read (%s) and is not used.", path.name, error)
        return
    if orientation not in (0, 1):
        raise DataError(
            path,
            "EXIF orientation",
            f"is {orientation}: the photo is stored rotated, and its pose may not include that",
            "rotate the pixels first (e.g. with `mogrify -auto-orient`), then estimate poses from the result",
        )


def _to_float(path: Path, image: Image.Image, sixteen_bits: bool) -> Float[np.ndarray, "H W C"]:
    """[H, W, 3 or 4] in [0, 1]."""
    if image.format in ("PNG", "TIFF", "WEBP") and getattr(image, "n_frames", 1) > 1:
        raise DataError(path, "pages", "are several in one file", "save each image as a file of its own")
    if image.mode in ("I;16", "I;16B", "I;16L", "I;16N"):
        grey = np.asarray(image).astype(np.float32) / 65535
        return np.repeat(grey[..., None], 3, axis=2)
    if sixteen_bits:
        return _read_sixteen_bits(path)
    if image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        raise DataError(path, "colour mode", f"is {image.mode}", "convert the image to 8-bit or 16-bit RGB")
    has_alpha = image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if has_alpha else "RGB"), np.float32) / 255


def _read_sixteen_bits(path: Path) -> Float[np.ndarray, "H W C"]:
    """PIL keeps only the upper 8 bits of 16-bit colour; OpenCV keeps all."""
    import cv2

    data = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if data is None or data.dtype != np.uint16 or data.ndim != 3 or data.shape[2] not in (3, 4):
        raise DataError(path, "pixels", "are 16-bit in a layout that is not known", "convert the image to 8-bit RGB")
    order = [2, 1, 0] if data.shape[2] == 3 else [2, 1, 0, 3]
    return data[..., order].astype(np.float32) / 65535
