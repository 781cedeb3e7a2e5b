"""Random images that a PNG holds exactly, finding one inside a larger image, PNG files of given bytes, and EXIF blocks."""

import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor


def noise(seed: int, height: int = 24, width: int = 20) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def array(seed: int, height: int = 40, width: int = 60) -> np.ndarray:
    """8-bit levels, so that a PNG holds it exactly."""
    generator = torch.Generator().manual_seed(seed)
    return (torch.randint(0, 256, (height, width, 3), generator=generator).float() / 255).numpy()


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, bits: int, colors: int, pixels: bytes) -> bytes:
    """A PNG file; `colors` is its colour type, and `pixels` may be fewer than its header promises."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colors, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", zlib.compress(pixels)) + png_chunk(b"IEND", b"")


def exif_orientation(orientation: int) -> Image.Exif:
    """The EXIF block of a photo that is stored turned."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


def holds(page: np.ndarray, image: np.ndarray, times: int = 1) -> bool:
    """Whether the image, every pixel `times` larger, is somewhere on the page, exactly."""
    pixels = (image * 255).round().astype(np.uint8).repeat(times, axis=0).repeat(times, axis=1)
    height, width = pixels.shape[:2]
    corners = np.argwhere((page[: -height + 1, : -width + 1] == pixels[0, 0]).all(axis=-1))
    return any(np.array_equal(page[y : y + height, x : x + width], pixels) for y, x in corners)
