"""Reading and writing of image files, and their EXIF blocks. Images that cannot be read exactly are refused; those of more than
100 megapixels are reduced by a whole factor.

The content of a file decides its format. A truncated file is an error, not an image with a grey bottom. 16 bits stay 16 bits.
Other colour profiles are converted to sRGB, in 8 bits. Alpha is composited over a given background before anything is resampled,
so that colours of transparent pixels do not show at edges. The caller decides whether the EXIF rotation is applied, because
programs disagree on whether a camera's pose includes it.
"""

from __future__ import annotations

import io
import logging
import math
import shlex
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import ExifTags, Image, ImageOps, TiffImagePlugin, UnidentifiedImageError
from torch import Tensor

from clear_strategies.core.images import to_bytes
from clear_strategies.errors import DataError
from clear_strategies.files import require_regular, write_bytes
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".jfif", ".webp", ".tif", ".tiff", ".heic", ".heif")
_FORMATS: Final = ("PNG", "JPEG", "WEBP", "TIFF")
_LOSSLESS: Final = ("PNG", "TIFF")
_HEIF_BRANDS: Final = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1")  # bytes 8 to 12, behind "ftyp"
_MAX_PIXELS: Final = 100_000_000  # of an image as it is returned, 1.2 GB; of larger photos, means of 2x2 or more pixels
_LARGEST: Final = 500_000_000  # pixels of a file with 8 bits, since a header may state any number
_PNG_END: Final = b"\0\0\0\0IEND\xaeB`\x82"  # the last chunk: size, kind and checksum
PNG_LEVEL: Final = 3  # a third of the time of zlib's default, for 5 % more bytes
_ADOBE_RGB: Final = "R03"  # EXIF's index of interoperability
_ON_THE_SIDE: Final = (5, 6, 7, 8)  # EXIF orientations that exchange width and height
_SAME_COLOR: Final = 4  # levels of 255 by which makers' sRGB profiles differ
_PROFILES_LOCK: Final = threading.Lock()  # several photos are read at once, and each profile is logged once
_OPENING_LOCK: Final = threading.Lock()  # Pillow's limit of pixels is one for all threads
_NCLX_PRIMARIES: Final = (1, 2)  # BT.709's, which are sRGB's, and unknown
_NCLX_TRANSFER: Final = (1, 2, 6, 13, 14, 15)  # BT.709's in all its names, unknown, and sRGB's
_LENS_TAGS: Final = (
    ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.LensModel, ExifTags.Base.FocalLength,
    ExifTags.Base.DigitalZoomRatio,
)  # fmt: skip


class Header(NamedTuple):
    """What is known of an image before it is decoded.

    Args:
        stored: width and height as in the file, of the image as `read_image` returns it.
        orientation: EXIF's, 1 (upright) to 8.
        has_alpha: the image may have transparent pixels.
        lossy: the format does not keep each value.
        focal_35mm: EXIF's focal length on 35 mm film of the same diagonal, mm; None: unknown.
        lens: EXIF's maker, model, lens, focal length and digital zoom, as written there.
    """

    path: Path
    stored: tuple[int, int]
    orientation: int
    has_alpha: bool
    lossy: bool
    focal_35mm: float | None
    lens: tuple[str, ...]

    def size(self, turn: bool | None) -> tuple[int, int]:
        """(width, height); `turn` and its error as of `read_image`."""
        if turn is None and self.orientation != 1:
            raise _rotation_error(self.path, self.orientation)
        width, height = self.stored
        return (height, width) if turn and self.orientation in _ON_THE_SIDE else (width, height)


def read_image(
    path: Path, *, background: Color | None = None, expect: tuple[int, int] | None = None, turn: bool | None = None
) -> Float[Tensor, "H W 3"]:
    """Read an image as RGB in [0, 1], float32; arguments and errors of `read_layers`."""
    return read_layers(path, background=background, expect=expect, turn=turn)[0]


def read_layers(
    path: Path, *, background: Color | None = None, expect: tuple[int, int] | None = None, turn: bool | None = None
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"] | None]:
    """Read an image as RGB in [0, 1], and its transparency, 1 - alpha; None: it has no alpha. Both are float32.

    Args:
        background: RGB in [0, 1] behind (straight) alpha: rgb · alpha + background · (1 - alpha). None: black, logged.
        expect: (width, height) that the image must have.
        turn: what to do with an EXIF rotation. True: apply it, and refuse a 16-bit PNG, which cannot be rotated. False: return
            the stored pixels, and refuse a TIFF, which decoders rotate. None: refuse the image.
    """
    with _opened(path) as image:
        sixteen_bits = _has_sixteen_bits(image)  # unknown after decoding
        orientation = _orientation_of(_tags(image))  # Pillow forgets that of a TIFF as it decodes it
        decoded_upright = image.format == "TIFF"  # by Pillow and by OpenCV
        as_asked = decoded_upright or not sixteen_bits if turn else turn is False and not decoded_upright
        if orientation != 1 and not as_asked:
            raise _rotation_error(path, orientation)
        if decoded_upright:  # with a name, Pillow would map the file into memory at its upright size, and scramble it
            image.filename = ""  # type: ignore[attr-defined]
        try:
            image.load()
        except Exception as error:  # PIL's decoders raise many types of error on damaged bytes
            remedy = "replace the damaged file, or go on without it: data.reader.skip_faulty=true"
            raise DataError(path, "pixels", f"cannot be decoded ({error})", remedy) from error
        if orientation != 1 and turn and not decoded_upright:
            ImageOps.exif_transpose(image, in_place=True)
        pixels = _to_float(path, image, sixteen_bits)
    height, width = pixels.shape[:2]
    if expect is not None and (width, height) != expect:
        problem = f"is {width}x{height} where {expect[0]}x{expect[1]} is expected"
        raise DataError(path, "size", problem, "use images of the size the cameras were made for")
    rgb, alpha = pixels[..., :3], pixels[..., 3:]
    if alpha.size and alpha.min() < 1:
        if background is None:
            _log.debug("%s has transparent pixels: composited over black.", path.name)
        rgb = rgb * alpha + np.asarray(background or (0, 0, 0), np.float32) * (1 - alpha)
    transparency = torch.from_numpy(1 - alpha[..., 0]) if alpha.size else None
    return torch.from_numpy(np.ascontiguousarray(rgb)), transparency


def read_header(path: Path) -> Header:
    """Read the header of an image; errors as of `read_image`, but of an EXIF rotation."""
    with _opened(path) as image:
        width, height = image.size
        # Some versions of PIL return the upright size of a rotated TIFF.
        if isinstance(image, TiffImagePlugin.TiffImageFile):
            width, height = image.tag_v2[TiffImagePlugin.IMAGEWIDTH], image.tag_v2[TiffImagePlugin.IMAGELENGTH]
        factor = _reduction_factor(width * height)
        stored, lossy = (-(-width // factor), -(-height // factor)), image.format not in _LOSSLESS
        tags, has_alpha = _tags(image, ExifTags.IFD.Exif), bool(image.has_transparency_data)
    lens = tuple(str(tags.get(tag, "")) for tag in _LENS_TAGS)
    return Header(path, stored, _orientation_of(tags), has_alpha, lossy, _focal_length(tags), lens)


def _focal_length(tags: Mapping[int, Any]) -> float | None:
    """`Header.focal_35mm`."""
    value = tags.get(ExifTags.Base.FocalLengthIn35mmFilm, 0)
    try:  # cameras also write 0, 0/0, text and tuples
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        number = math.nan
    return number if math.isfinite(number) and number > 0 else None


def write_png(path: Path, image: Float[Tensor, "H W 3"] | Float[Tensor, "H W"]) -> None:
    """Write an 8-bit PNG atomically; an [H, W] image becomes grey. Values outside [0, 1] are clamped."""
    write_bytes(path, png_bytes(image))


def png_bytes(image: Float[Tensor, "H W 3"] | Float[Tensor, "H W"]) -> bytes:
    """Return the bytes of the file that `write_png` writes."""
    buffer = io.BytesIO()
    Image.fromarray(to_bytes(image)).save(buffer, format="PNG", compress_level=PNG_LEVEL)
    return buffer.getvalue()


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open an image and check its size, without decoding its pixels."""
    require_regular(path)
    formats = (*_FORMATS, "HEIF") if _is_heif(path) else _FORMATS
    try:
        with _OPENING_LOCK, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PIL's warnings: damage fails on decoding
            limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # 200 megapixels of a phone exceed it
            try:
                image = Image.open(path, formats=formats)
                if image.mode == "P" and image.palette is None:  # PIL asserts that later
                    raise UnidentifiedImageError("its palette is missing")
            finally:
                Image.MAX_IMAGE_PIXELS = limit
    except FileNotFoundError as error:
        raise DataError(path, "file", "is not there", "check the path") from error
    except Exception as error:  # PIL raises many types of error on damaged headers
        if isinstance(error, OSError) and error.strerror:  # the system's, such as for a file of another user
            remedy = "check the file, or go on without it: data.reader.skip_faulty=true"
            raise DataError(path, "file", f"cannot be read ({error.strerror})", remedy) from error
        remedy = f"use one of {', '.join(_FORMATS)}, or go on without the file: data.reader.skip_faulty=true"
        raise DataError(path, "file", f"is no readable image ({type(error).__name__})", remedy) from error
    with image:
        if image.width * image.height > (most := _MAX_PIXELS if _has_sixteen_bits(image) else _LARGEST):
            problem = f"{image.width}x{image.height} is more than {most:,} pixels"
            raise DataError(path, "size", problem, f"reduce it: mogrify -resize 50% {shlex.quote(str(path))}")
        yield image


@lru_cache(maxsize=16)  # logs once for photos of one size
def _reduction_factor(pixels: int) -> int:
    """The factor by which the sides of an image with this number of pixels are reduced when it is read."""
    factor = math.ceil(math.sqrt(pixels / _MAX_PIXELS))
    if factor > 1:
        _log.info("photos of %d megapixels are read at 1/%d of their width and height.", pixels // 10**6, factor)
    return factor


def _reduced(image: Image.Image) -> Image.Image:
    factor = _reduction_factor(image.width * image.height)
    return image if factor == 1 else image.reduce(factor)


def _has_sixteen_bits(image: Image.Image) -> bool:
    """Return True if the file has 16 bits per channel; known only until the image is decoded."""
    if isinstance(image, TiffImagePlugin.TiffImageFile):
        return 16 in image.tag_v2.get(TiffImagePlugin.BITSPERSAMPLE, ())
    return ";16" in str(getattr(image, "tile", ""))


def _is_heif(path: Path) -> bool:
    """Return True if the content is HEIC or HEIF, after enabling PIL to open it; a DataError if pillow-heif is not installed."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return False  # opening it as an image raises the error
    if head[4:8] != b"ftyp" or head[8:] not in _HEIF_BRANDS:
        return False
    try:
        import pillow_heif
    except ImportError as error:
        remedy = "pip install 'clear-strategies[heic]', or save the photo as JPEG"
        raise DataError(path, "HEIC", "needs pillow-heif, which is not installed", remedy) from error
    pillow_heif.register_heif_opener()  # rotates images upright, and sets the orientation in their EXIF block to match
    return True


def _orientation_of(tags: Mapping[int, Any]) -> int:
    """The EXIF orientation, 1 to 8; 1, upright, if it is missing or cannot be read."""
    orientation = tags.get(ExifTags.Base.Orientation, 1)
    return orientation if orientation in range(1, 9) else 1


def _tags(image: Image.Image, *blocks: int) -> dict[int, Any]:
    """The tags of an image's EXIF block, and of the given blocks in it, up to the first that cannot be read."""
    tags = dict[int, Any]()
    try:
        # The method of PNG files decodes them, to find a block that lies behind the pixels.
        exif = Image.Image.getexif(_without_pixels(image) if image.format == "PNG" else image)
        tags.update(exif)
        for block in blocks:
            tags.update(exif.get_ifd(block))
    except Exception as error:  # PIL raises many types of error on damaged blocks
        _log.debug("%s: its EXIF block cannot be read (%s) and is not used.", image.filename, error)  # type: ignore[attr-defined]
    return tags


def _without_pixels(image: Image.Image) -> Image.Image:
    """Open the file of a PNG image again, without the chunks that hold pixels."""
    with Path(image.filename).open("rb") as file:  # type: ignore[attr-defined]
        chunks = [file.read(8)]
        while len(head := file.read(8)) == 8 and head[4:] != _PNG_END[4:8]:
            size = int.from_bytes(head[:4], "big") + 4  # with its checksum
            if head[4:] in (b"IDAT", b"fdAT"):
                file.seek(size, io.SEEK_CUR)
            else:
                chunks += [head, file.read(size)]
    return Image.open(io.BytesIO(b"".join([*chunks, _PNG_END])), formats=("PNG",))


def _rotation_error(path: Path, orientation: int) -> DataError:
    problem = f"is {orientation}: the photo is stored turned, and its pose may not include that"
    remedy = "turn the pixels first (e.g. with `mogrify -auto-orient`), then estimate poses from the result"
    return DataError(path, "EXIF orientation", problem, remedy)


def _to_float(path: Path, image: Image.Image, sixteen_bits: bool) -> Float[np.ndarray, "H W C"]:
    """Convert a decoded image to sRGB, with alpha if it has any: [H, W, 3 or 4] in [0, 1]."""
    if image.format in ("PNG", "TIFF", "WEBP") and getattr(image, "n_frames", 1) > 1:
        raise DataError(path, "pages", "are several in one file", "save each image as a file of its own")
    if sixteen_bits and not _is_plain(image):
        raise _unknown_layout(path)
    if image.mode in ("I;16", "I;16B", "I;16L", "I;16N"):
        return np.repeat(np.asarray(image).astype(np.float32)[..., None] / 65535, 3, axis=2)
    if image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        raise DataError(path, "colour mode", f"is {image.mode}", "convert the image to 8-bit or 16-bit RGB")
    to_srgb = _to_srgb_of(image)
    if sixteen_bits and to_srgb is None:
        return _read_sixteen_bits(path)
    pixels = np.array(_reduced(image.convert("RGBA" if image.has_transparency_data else "RGB")), np.float32) / 255
    if to_srgb is not None:
        pixels[..., :3] = np.asarray(_reduced(to_srgb.apply(image.convert(to_srgb.input_mode))), np.float32) / 255
    return pixels


def _to_srgb_of(image: Image.Image) -> Any:
    """The transform from the image's colours to sRGB; None if they are sRGB, or the file has no profile."""
    with _PROFILES_LOCK:
        if profile := image.info.get("icc_profile"):
            return _to_srgb(profile, image.mode in ("1", "L", "LA"))
        nclx = image.info.get("nclx_profile") or {}
        primaries, transfer = nclx.get("color_primaries", 1), nclx.get("transfer_characteristics", 1)
        if primaries not in _NCLX_PRIMARIES or transfer not in _NCLX_TRANSFER:
            h273 = f"the primaries {primaries} and the transfer {transfer} of ITU-T H.273 (HDR, or a wide gamut)"
            _warn_of_colors(h273)
        elif _tags(image, ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) == _ADOBE_RGB:
            _warn_of_colors("Adobe RGB (EXIF)")
        return None


@lru_cache(maxsize=16)  # photos of one camera have the same profile, which is logged once
def _to_srgb(profile: bytes, grey: bool) -> Any:
    from PIL import ImageCms

    try:
        own, srgb = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        mode = "L" if grey and own.profile.xcolor_space.strip() == "GRAY" else "RGB"
        name = ImageCms.getProfileDescription(own).strip()
        transform = ImageCms.buildTransform(own, srgb, mode, "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
    except (ImageCms.PyCMSError, OSError) as error:
        _log.warning("photos have a colour profile that cannot be used (%s): their colours are taken as sRGB.", error)
        return None
    levels = np.indices((6, 6, 6)).reshape(3, 36, 6).transpose(1, 2, 0).astype(np.uint8) * 51
    sample = Image.fromarray(levels).convert(mode)
    before, after = (np.asarray(i, np.int16) for i in (sample.convert("RGB"), transform.apply(sample)))
    if np.abs(after - before).max() <= _SAME_COLOR:
        return None
    _log.info("photos have the colours of %s: they are converted to sRGB.", name)
    return transform


@lru_cache(maxsize=16)
def _warn_of_colors(colors: str) -> None:
    """Warn once of photos whose files state other colours than sRGB, without a profile to convert them."""
    _log.warning("photos have the colours of %s, and are taken as sRGB. Export them in sRGB.", colors)


def _is_plain(image: Image.Image) -> bool:
    """False for a 16-bit TIFF of which Pillow and OpenCV return other values: inverted, multiplied by alpha, or by channel."""
    if not isinstance(image, TiffImagePlugin.TiffImageFile):
        return True
    tags = image.tag_v2
    inverted = tags.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == 0
    multiplied = 1 in tags.get(TiffImagePlugin.EXTRASAMPLES, ())
    by_channel = tags.get(TiffImagePlugin.PLANAR_CONFIGURATION) == 2 and len(image.getbands()) > 1
    return not (inverted or multiplied or by_channel)


def _unknown_layout(path: Path) -> DataError:
    problem = "are 16-bit in a layout that is not known"
    return DataError(path, "pixels", problem, "convert the image to 8-bit RGB, or to a 16-bit PNG")


def _read_sixteen_bits(path: Path) -> Float[np.ndarray, "H W C"]:
    """Read 16-bit colour by OpenCV, since PIL keeps only the upper 8 bits."""
    import cv2

    data = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if data is None or data.dtype != np.uint16 or data.ndim != 3 or data.shape[2] not in (3, 4):
        raise _unknown_layout(path)
    order = [2, 1, 0] if data.shape[2] == 3 else [2, 1, 0, 3]
    return data[..., order].astype(np.float32) / 65535
