"""Image files, read and written. What cannot be read exactly is refused, with a remedy.

The content of a file decides its kind. A truncated file is an error, not an image with a grey bottom. 16 bits stay 16
bits. Alpha is composited over a stated background. Whether a photo is turned as its EXIF block says is for the caller to
decide, because programs disagree on whether a camera's pose includes the turn.
"""

from __future__ import annotations

import io
import logging
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from PIL.TiffImagePlugin import TiffImageFile
from torch import Tensor

from clear_strategies.core.images import to_bytes
from clear_strategies.errors import DataError
from clear_strategies.files import require_regular, write_bytes
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".heic", ".heif")
_FORMATS: Final = ("PNG", "JPEG", "WEBP", "TIFF")
_HEIF_BRANDS: Final = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1")  # bytes 8 to 12, behind "ftyp"
_MAX_PIXELS: Final = 100_000_000
_FOLDERS: Final = ("images", "images_2", "images_4", "images_8")
_LONGEST_NAME: Final = 1024
_LARGE: Final = 1 << 24  # pixels; smaller images may be drawings, which compress without limit
_BOMB: Final = 200
PNG_LEVEL: Final = 3  # a third of the time of zlib's default, for 5 % more bytes
_EXIF_ORIENTATION: Final = 0x0112
_EXIF_PHOTO: Final = 0x8769
# What makes [H, W, C] pixels upright, by their EXIF orientation.
_TURNS: Final[dict[int, Callable[[np.ndarray], np.ndarray]]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a.swapaxes(0, 1)[::-1],
}
_ON_THE_SIDE: Final = (5, 6, 7, 8)
_BACK: Final = {6: 8, 8: 6}  # the turn that undoes a turn; all others undo themselves
_TIFF_SIZE: Final = (256, 257)  # tags: the width and height that are stored


def read_image(
    path: Path,
    *,
    background: Color | None = None,
    expect: tuple[int, int] | None = None,
    turn: bool | None = None,
) -> Float[Tensor, "H W 3"]:
    """RGB in [0, 1], float32.

    Args:
        background: RGB in [0, 1] behind (straight) alpha: rgb · alpha + background · (1 - alpha). None: black, logged.
        expect: (width, height) the image must have.
        turn: an image that its EXIF block says is stored turned: True turns it upright, False keeps the stored pixels, None
            refuses it.

    Raises:
        DataError: the file is no PNG, JPEG, WebP, TIFF or HEIC, is damaged or too large, or the image is turned by EXIF, has
            an unknown colour mode, or has another size.
    """
    with _opened(path, turn) as image:
        sixteen_bits = ";16" in str(getattr(image, "tile", ""))  # the layout in the file, unknown after decoding
        size = _size(image, turn)
        if expect is not None and size != expect:
            problem = f"is {size[0]}x{size[1]} where {expect[0]}x{expect[1]} is expected"
            raise DataError(path, "size", problem, "use images of the size the cameras were made for")
        undone = orientation_of(image) if image.format == "TIFF" else 1  # PIL and OpenCV decode TIFF upright
        try:
            image.load()
        except Exception as error:  # PIL's decoders raise many types of error on damaged bytes
            remedy = "replace the damaged file, or go on without it: data.broken=skip"
            raise DataError(path, "pixels", f"cannot be decoded ({error})", remedy) from error
        if turn is None:
            _refuse_turned(path, image)
        pixels = _to_float(path, image, sixteen_bits)
        if turn and image.format != "TIFF":
            pixels = _TURNS[orientation_of(image)](pixels)
        elif not turn:
            pixels = _TURNS[_BACK.get(undone, undone)](pixels)
    rgb, alpha = pixels[..., :3], pixels[..., 3:]
    if alpha.size and alpha.min() < 1:
        if background is None:
            _log.debug("%s has transparent pixels: composited over black.", path.name)
        rgb = rgb * alpha + np.asarray(background or (0, 0, 0), np.float32) * (1 - alpha)
    return torch.from_numpy(np.ascontiguousarray(rgb))


def image_size(path: Path, *, turn: bool | None = None) -> tuple[int, int]:
    """(width, height), from the header only; `turn` and the DataErrors as of `read_image`."""
    with _opened(path, turn) as image:
        return _size(image, turn)


def has_alpha(path: Path) -> bool:
    """Whether the file may have transparent pixels, from the header only; the DataErrors as of `read_image`."""
    with _opened(path, False) as image:
        return _has_alpha(image)


def orientation_of(image: Image.Image) -> int:
    """The EXIF orientation of an opened image, 1 to 8; 1, upright, where there is none or it cannot be read."""
    try:
        orientation = image.getexif().get(_EXIF_ORIENTATION, 1)
    except Exception as error:  # PIL raises many types of error on damaged blocks
        _log.debug("%s: its EXIF block cannot be read (%s) and is not used.", image.filename, error)  # type: ignore[attr-defined]
        return 1
    return orientation if orientation in _TURNS else 1


def exif_of(path: Path) -> dict[int, Any]:
    """The tags of an EXIF block, its photo part included; empty where it cannot be read. DataErrors as of `read_image`."""
    with _opened(path, False) as image:
        try:
            block = image.getexif()
            return {**block, **block.get_ifd(_EXIF_PHOTO)}
        except Exception as error:  # as above
            _log.debug("%s: its EXIF block cannot be read (%s) and is not used.", path.name, error)
            return {}


def image_folder(root: Path, name: str | None = None) -> Path:
    """The folder of photos in `root`; without a name, the first of images, images_2, images_4, images_8.

    Raises:
        DataError: it is not there.
    """
    present = [folder for folder in _FOLDERS if (root / folder).is_dir()]
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
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
    """The image files of a folder, by their suffix, in order of names. Other files and hidden ones are ignored.

    Raises:
        DataError: the folder is not there, or holds no image.
    """
    if not folder.is_dir():
        raise DataError(folder, "folder", "is not there", "check the path")
    if not (found := images_in(folder)):
        raise DataError(folder, "images", f"holds no image ({', '.join(SUFFIXES)})", "check the path")
    return found


def images_in(folder: Path, pattern: str = "*") -> list[Path]:
    """As `list_images`, also where there is none; with the pattern "**/*" those of the folders below, too."""
    found = sorted(p for p in folder.glob(pattern) if p.suffix.lower() in SUFFIXES and p.is_file())
    return [p for p in found if not any(part.startswith(".") for part in p.relative_to(folder).parts)]


def require_text(names: Iterable[str]) -> None:
    """Raise a DataError for a name that is no UTF-8, which would spoil pictures, pages and JSON after training."""
    for name in names:
        if (shown := name.encode(errors="backslashreplace").decode()) != name:
            raise DataError(shown, "name", "must be UTF-8, has another byte", "rename this folder or photo")


def by_stem(paths: Iterable[Path]) -> dict[str, list[Path]]:
    """The files by their names without endings."""
    found: dict[str, list[Path]] = {}
    for path in paths:
        found.setdefault(path.stem, []).append(path)
    return found


def write_png(path: Path, image: Float[Tensor, "H W 3"] | Float[Tensor, "H W"]) -> None:
    """8-bit PNG, written atomically; a [H, W] image is grey. Values outside [0, 1] are clamped."""
    buffer = io.BytesIO()
    Image.fromarray(to_bytes(image)).save(buffer, format="PNG", compress_level=PNG_LEVEL)
    write_bytes(path, buffer.getvalue())


def jpeg(image: Float[Tensor, "H W 3"], quality: int = 90) -> bytes:
    """A small file of an image in [0, 1], for display and not for measurements."""
    buffer = io.BytesIO()
    Image.fromarray(to_bytes(image)).save(buffer, format="JPEG", quality=quality, subsampling=0)
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
        remedy = "keep the images inside the data set's folder, or follow it: data.reader.allow_outside=true"
        raise DataError(file, "file name", f"{name!r} leads out of {root}", remedy)
    return root / name


@contextmanager
def _opened(path: Path, turn: bool | None) -> Iterator[Image.Image]:
    require_regular(path)
    formats = (*_FORMATS, "HEIF") if _is_heif(path) else _FORMATS
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PIL's warnings: our own size limit follows, and damage fails on decoding
            image = Image.open(path, formats=formats)
    except FileNotFoundError as error:
        raise DataError(path, "file", "is not there", "check the path") from error
    except Exception as error:  # PIL raises many types of error on damaged headers
        remedy = f"use one of {', '.join(_FORMATS)}, or go on without the file: data.broken=skip"
        raise DataError(path, "file", f"is no readable image ({type(error).__name__})", remedy) from error
    with image:
        if image.width * image.height > _MAX_PIXELS:
            problem = f"{image.width}x{image.height} is more than {_MAX_PIXELS:,} pixels"
            raise DataError(path, "size", problem, "downsample the images before training")
        if image.width * image.height > _LARGE and image.width * image.height * 3 > _BOMB * path.stat().st_size:
            problem = f"{image.width}x{image.height} pixels are more than {_BOMB} times the file, as in no photo"
            raise DataError(path, "size", problem, "use the camera's own file")
        # A PNG may keep its EXIF block behind the pixels; `read_image` checks again after decoding them.
        if turn is None and (image.format != "PNG" or "exif" in image.info):
            _refuse_turned(path, image)
        yield image


def _is_heif(path: Path) -> bool:
    """Whether the content is HEIC or HEIF, which PIL can then open; a DataError if pillow-heif is not installed."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return False  # opening it as an image says why
    if head[4:8] != b"ftyp" or head[8:] not in _HEIF_BRANDS:
        return False
    try:
        import pillow_heif
    except ImportError as error:
        remedy = "pip install 'clear-strategies[heic]', or save the photo as JPEG"
        raise DataError(path, "HEIC", "needs pillow-heif, which is not installed", remedy) from error
    pillow_heif.register_heif_opener()  # which turns images upright, and says so in their EXIF block
    return True


def _refuse_turned(path: Path, image: Image.Image) -> None:
    if (orientation := orientation_of(image)) != 1:
        problem = f"is {orientation}: the photo is stored turned, and its pose may not include that"
        remedy = "turn the pixels first (e.g. with `mogrify -auto-orient`), then estimate poses from the result"
        raise DataError(path, "EXIF orientation", problem, remedy)


def _size(image: Image.Image, turn: bool | None) -> tuple[int, int]:
    """(width, height) of an image that is not decoded yet. Of a turned TIFF some versions of PIL say the upright size."""
    width, height = (image.tag_v2[tag] for tag in _TIFF_SIZE) if isinstance(image, TiffImageFile) else image.size
    return (height, width) if turn and orientation_of(image) in _ON_THE_SIDE else (width, height)


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
    return np.asarray(image.convert("RGBA" if _has_alpha(image) else "RGB"), np.float32) / 255


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info


def _read_sixteen_bits(path: Path) -> Float[np.ndarray, "H W C"]:
    """PIL keeps only the upper 8 bits of 16-bit colour; OpenCV keeps all."""
    import cv2

    data = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if data is None or data.dtype != np.uint16 or data.ndim != 3 or data.shape[2] not in (3, 4):
        raise DataError(path, "pixels", "are 16-bit in a layout that is not known", "convert the image to 8-bit RGB")
    order = [2, 1, 0] if data.shape[2] == 3 else [2, 1, 0, 3]
    return data[..., order].astype(np.float32) / 65535
