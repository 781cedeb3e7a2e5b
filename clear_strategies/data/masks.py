"""Mask files: matching them to photos, and reading them."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Final

import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor

from clear_strategies.data.file_names import name_key, some
from clear_strategies.data.lenses import Lens
from clear_strategies.data.photo_files import SUFFIXES, read_header, read_image
from clear_strategies.data.photo_folders import images_in
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_MARKED: Final = re.compile(r"^(?:.*mask[-_.])?(.+?)(?:[-_.]mask)?$")  # dynamic_mask_0001, 0001_mask


def masks_of(root: Path, paths: Iterable[Path], given: Mapping[Path, Path] = MappingProxyType({})) -> dict[Path, Path]:
    """Find the masks of photos. A warning names the files in a folder of masks that match no photo.

    Masks lie in a folder `masks` (or `mask`) that replaces one folder of the photo's path below `root`, or lies in one of them;
    for images_4, `masks_4` is preferred. A mask is named like its photo, with or without its suffix, in any case, and may be
    marked: 0001.png, 0001.jpg.png, 0001_mask.png, dynamic_mask_0001.png. Marked masks may also lie among the photos, see
    `masks_among`.

    Args:
        given: masks that the capture names, by their photos.

    Returns:
        The masks by their photos.
    """
    found, used = dict(given), set(given.values())
    folders = dict[Path, dict[str, Path]]()
    for parent in dict.fromkeys(path.parent for path in paths):
        for folder in filter(Path.is_dir, dict.fromkeys(_mask_folders(root, parent))):
            masks = folders.setdefault(folder, _by_name(folder))
            for photo in images_in(parent):
                names = (name_key(photo.stem), name_key(photo.name))
                if mask := next((masks[name] for name in names if name in masks), None):
                    found.setdefault(photo, mask)
                    used.add(mask)
        found = masks_among(images_in(parent)) | found
    for folder in folders:
        listed = sorted(file for file in folder.iterdir() if file.is_file() and not file.name.startswith("."))
        if unused := [file.name for file in listed if file not in used]:
            message = "%s: %d of %d files belong to no photo and are not used: %s. Name a mask like its photo."
            _log.warning(message, folder, len(unused), len(listed), some(unused))
    return found


def masks_among(photos: Sequence[Path]) -> dict[Path, Path]:
    """Find the masks among the images of a folder, by their photos: 0001.jpg.mask.png (RealityCapture), 0001_mask.png."""
    named = {name_key(name): photo for photo in photos for name in (photo.stem, photo.name)}
    marked = {file: _MARKED.sub(r"\g<1>", stem) for file in photos if (stem := name_key(file.stem))}
    return {named[name]: file for file, name in marked.items() if named.get(name, file).stem != file.stem}


def _mask_folders(root: Path, parent: Path) -> Iterator[Path]:
    """Yield the folders in which masks of the photos in `parent` may lie, the preferred ones first."""
    parts = parent.relative_to(root).parts if parent.is_relative_to(root) else ()
    for i, part in enumerate(parts):
        size = part.removeprefix("images") if part.startswith("images") else ""
        for name in (f"masks{size}", "masks", "mask"):
            yield root.joinpath(*parts[:i], name, *parts[i + 1 :])
    for name in ("masks", "mask"):
        yield from (root.joinpath(*parts[:i], name, *parts[i:]) for i in range(len(parts) or 1))
        yield parent / name


def _by_name(folder: Path) -> dict[str, Path]:
    """The masks of a folder by the names that their photos may have; unmarked names are preferred, then PNG files."""
    masks = dict[str, Path]()
    files = sorted(images_in(folder), key=lambda file: file.suffix.lower() != SUFFIXES[0])
    for names in (r"\g<0>", r"\g<1>"):
        for file in files:
            masks.setdefault(_MARKED.sub(names, name_key(file.stem)), file)
    return masks


def check_mask(path: Path, lens: Lens, turn: bool | None) -> None:
    """Raise a DataError unless a mask has the aspect ratio of the lens. Reads only the header; `turn`: see `read_image`."""
    with _errors_of_mask():
        lens.resized(*read_header(path).size(turn), path)


def read_mask(path: Path, lens: Lens, pinhole: Lens, turn: bool | None) -> Bool[Tensor, "H W"]:
    """Read a mask at the size of `lens`, undistorted for `pinhole`; False at hidden pixels.

    The value 0 hides, as in COLMAP and nerfstudio, so a mask of 0 and 1 means the same as one of 0 and 255. In a lossy file,
    where 0 is not exact, values up to half of the largest one hide.
    """
    with _errors_of_mask():
        values = read_image(path, turn=turn).amax(dim=2)
        shown = (values > (values.max() / 2 if read_header(path).lossy else 0)).float()
    shown = F.interpolate(shown[None, None], (lens.height, lens.width), mode="nearest-exact")[0, 0]
    if lens.distorts:
        shown = lens.undistort(shown, pinhole)
    return shown > 0.5


@contextmanager
def _errors_of_mask() -> Iterator[None]:
    """Raise DataErrors again with a remedy for masks: that for photos does not apply."""
    try:
        yield
    except DataError as error:
        remedy = "put a mask of the photo's shape there, or remove it and the field that names it"
        raise DataError(error.file, f"mask: {error.field}", error.problem, remedy) from error
