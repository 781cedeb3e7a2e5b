"""Image files: damaged, of a kind that is not read, too large, turned, or not of the size that is expected."""

import io
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from clear_strategies.data.photo_files import read_header, read_image
from tests.helpers.image_files import exif_orientation
from tests.stress.bad_inputs import BadInput, a_device, at, bomb


def _encoded(form: str, mode: str = "RGB", size: tuple[int, int] = (40, 30), **options: Any) -> bytes:
    noise = np.random.default_rng(0).integers(0, 256, (*size[::-1], 3), np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noise).convert(mode).save(stream, form, **options)
    return stream.getvalue()


def _pages(form: str) -> bytes:
    pages = [Image.new("RGB", (8, 8), color) for color in ("red", "blue")]
    stream = io.BytesIO()
    pages[0].save(stream, form, save_all=True, append_images=pages[1:])
    return stream.getvalue()


def _read(content: bytes, **options: Any) -> Callable[[Path], object]:
    return at("a.png", partial(read_image, **options), content)


def _flipped(content: bytes, at: int) -> bytes:
    data = bytearray(content)
    data[at] ^= 0xFF
    return bytes(data)


_PNG, _JPEG, _WEBP, _TIFF = (_encoded(form) for form in ("PNG", "JPEG", "WEBP", "TIFF"))
_UNREADABLE, _BROKEN = "a.png: file: is no readable image", "a.png: pixels: cannot be decoded"
_CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "absent": (at("none.png", read_image), "none.png: file: is not there"),
    "a folder": (at("a.png", read_image, Path.mkdir), r"a.png: file: cannot be read \(Is a directory\): check the file"),
    "a pipe": (at("a.png", read_header, os.mkfifo), "a.png: file: is a pipe, a device or a socket"),
    "a device": (at("a.png", read_image, a_device), "a.png: file: is a pipe, a device or a socket"),
    "empty": (_read(b""), _UNREADABLE),
    "text": (_read(b"not a picture\n" * 9), _UNREADABLE),
    "GIF": (_read(_encoded("GIF", "P")), _UNREADABLE),
    "BMP": (_read(_encoded("BMP")), _UNREADABLE),
    "PNG cut in its pixels": (_read(_PNG[:-60]), _BROKEN),
    "PNG with a flipped byte of pixels": (_read(_flipped(_PNG, len(_PNG) // 2)), _BROKEN),
    "PNG with a flipped byte of its size": (_read(_flipped(_PNG, 19)), f"{_UNREADABLE}|{_BROKEN}|size"),
    "PNG without its signature": (_read(_PNG[8:]), _UNREADABLE),
    "JPEG cut in its pixels": (_read(_JPEG[:-200]), _BROKEN),
    "WebP cut": (_read(_WEBP[:-40]), f"{_UNREADABLE}|{_BROKEN}"),
    "TIFF cut": (_read(_TIFF[: len(_TIFF) // 2]), f"{_UNREADABLE}|{_BROKEN}"),
    "TIFF of two pages": (_read(_pages("TIFF")), "a.png: pages: are several in one file"),
    "moving PNG": (_read(_pages("PNG")), "a.png: pages: are several in one file"),
    "moving WebP": (_read(_pages("WEBP")), "a.png: pages: are several in one file"),
    "CMYK JPEG": (_read(_encoded("JPEG", "CMYK")), "a.png: colour mode: is CMYK"),
    "TIFF of floats": (_read(_encoded("TIFF", "F")), "a.png: colour mode: is F"),
    "TIFF of 32-bit numbers": (_read(_encoded("TIFF", "I")), "a.png: colour mode: is I"),
    "LAB TIFF": (_read(_encoded("TIFF", "LAB")), "a.png: colour mode: is LAB"),
    **{
        f"JPEG turned by EXIF {i}": (_read(_encoded("JPEG", exif=exif_orientation(i))), f"EXIF orientation: is {i}")
        for i in range(2, 9)
    },
    "PNG turned by EXIF": (_read(_encoded("PNG", exif=exif_orientation(6))), "EXIF orientation: is 6"),
    "another size": (_read(_PNG, expect=(30, 40)), "a.png: size: is 40x30 where 30x40 is expected"),
    "larger than allowed": (_read(bomb(30_000, 20_000)), "a.png: size: 30000x20000 is more than 500,000,000 pixels"),
    "header of 3.6 gigapixels": (_read(bomb(60_000, 60_000)), "a.png: (size|file)"),
}  # fmt: skip
INPUTS = [BadInput("image", name, give, pattern) for name, (give, pattern) in _CASES.items()]
