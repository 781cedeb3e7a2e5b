"""Masks: whose file is whose, and what it hides."""

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

from clear_strategies.data.file_names import alike, some
from clear_strategies.data.lenses import Lens
from clear_strategies.data.photo_files import SUFFIXES, image_size, is_lossy, read_image
from clear_strategies.data.photo_folders import images_in
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_MARKED: Final = re.compile(r"^(?:.*mask[-_.])?(.+?)(?:[-_.]mask)?$")  # dynamic_mask_0001, 0001_mask


def masks_of(root: Path, paths: Iterable[Path], given: Mapping[Path, Path] = MappingProxyType({})) -> dict[Path, Path]:
    """The mask of each photo that has one; a warning names the files in a folder of masks that belong to no photo.

    Args:
        given: the masks of photos whose capture names them.

    Masks lie in a folder `masks` (or `mask`), in place of one folder of the photo's path below `root`, or in one of them; beside
    images_4, `masks_4` comes first. A mask is named like its photo, with its ending or without, in any case, and may be marked:
    0001.png, 0001.jpg.png, 0001_mask.png, dynamic_mask_0001.png. Marked ones may also lie among the photos, see `masks_among`.
    """
    found, used, folders = dict(given), set(given.values()), dict[Path, dict[str, Path]]()
    for parent in dict.fromkeys(path.parent for path in paths):
        for folder in filter(Path.is_dir, dict.fromkeys(_folders(root, parent))):
            masks = folders.setdefault(folder, _by_name(folder))
            for photo in images_in(parent):
                names = (alike(photo.stem), alike(photo.name))
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
    """The masks that lie among the photos of a folder, by the photo: 0001.jpg.mask.png of RealityCapture, 0001_mask.png."""
    named = {alike(name): photo for photo in photos for name in (photo.stem, photo.name)}
    marked = {file: _MARKED.sub(r"\g<1>", stem) for file in photos if (stem := alike(file.stem))}
    return {named[name]: file for file, name in marked.items() if named.get(name, file).stem != file.stem}


def _folders(root: Path, parent: Path) -> Iterator[Path]:
    parts = parent.relative_to(root).parts if parent.is_relative_to(root) else ()
    for i, part in enumerate(parts):
        size = part.removeprefix("images") if part.startswith("images") else ""
        for name in (f"masks{size}", "masks", "mask"):
            yield root.joinpath(*parts[:i], name, *parts[i + 1 :])
    for name in ("masks", "mask"):
        yield root.joinpath(name, *parts)
        yield parent / name


def _by_name(folder: Path) -> dict[str, Path]:
    """The masks of a folder by the names that their photos may have; the plainest name comes first, then PNG."""
    masks = dict[str, Path]()
    files = sorted(images_in(folder), key=lambda file: file.suffix.lower() != SUFFIXES[0])
    for names in (r"\g<0>", r"\g<1>"):
        for file in files:
            masks.setdefault(_MARKED.sub(names, alike(file.stem)), file)
    return masks


def check_mask(path: Path, lens: Lens, turn: bool | None) -> None:
    """A DataError where a mask is no image of its lens's shape, by its header; `turn` as of `read_image`."""
    with _of_mask():
        lens.resized(*image_size(path, turn=turn), path)


def read_mask(path: Path, lens: Lens, pinhole: Lens, turn: bool | None) -> Bool[Tensor, "H W"]:
    """False where the mask hides its photo: where it is 0, as in COLMAP and nerfstudio, so that 0 and 1 are a mask as 0 and 255
    are. Of a lossy file, whose 0 is not exact, at most half of its largest value. It is brought to the size of `lens`.
    """
    with _of_mask():
        values = read_image(path, turn=turn).amax(dim=2)
        shown = (values > (values.max() / 2 if is_lossy(path) else 0)).float()
    shown = F.interpolate(shown[None, None], (lens.height, lens.width), mode="nearest-exact")[0, 0]
    if lens.distorts:
        shown = lens.undistort(shown, pinhole)
    return shown > 0.5


@contextmanager
def _of_mask() -> Iterator[None]:
    """What would help a photo does not help its mask."""
    try:
        yield
    except DataError as error:
        remedy = "put a mask of the photo's shape there, or remove it and the field that names it"
        raise DataError(error.file, f"mask: {error.field}", error.problem, remedy) from error
