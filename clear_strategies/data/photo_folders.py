"""The photos of a folder or a capture: where they are, and which can be used."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final, TypeVar

from clear_strategies.data.photo_files import SUFFIXES, read_image
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_FOLDERS: Final = ("images", "images_2", "images_4", "images_8")
_LISTED: Final = 5  # names in a message, at most

_Entry = TypeVar("_Entry")


def image_folder(root: Path, name: str | None = None) -> Path:
    """The folder of photos in `root`; without a name, the first of images, images_2, images_4, images_8.

    Raises:
        DataError: it does not exist.
    """
    present = [folder for folder in _FOLDERS if (root / folder).is_dir()]
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    if name is not None:
        if not (root / name).is_dir():
            remedy = f"choose one of {', '.join(present)}" if present else "check the path"
            raise DataError(root / name, "images", "is no folder", remedy)
        return root / name
    if not present:
        raise DataError(root, "images", f"has none of the folders {', '.join(_FOLDERS)}", "name the folder of photos")
    return root / present[0]


def folder_note(folder: Path) -> str:
    """The folder's name, and which others exist beside it, for the plan."""
    others = [name for name in _FOLDERS if name != folder.name and (folder.parent / name).is_dir()]
    return f"{folder.name} (there are also {', '.join(others)})" if others else folder.name


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder, by their suffix, in order of names. Other files and hidden ones are ignored.

    Raises:
        DataError: the folder does not exist, or holds no image.
    """
    if not folder.is_dir():
        raise DataError(folder, "folder", "is not there", "check the path")
    if not (images := images_in(folder)):
        raise DataError(folder, "images", f"holds no image ({', '.join(SUFFIXES)})", "check the path")
    return images


def images_in(folder: Path, pattern: str = "*") -> list[Path]:
    """As `list_images`, but empty where there is none; with the pattern "**/*" also those of the folders below."""
    images = sorted(p for p in folder.glob(pattern) if p.suffix.lower() in SUFFIXES and p.is_file())
    return [p for p in images if not any(part.startswith(".") for part in p.relative_to(folder).parts)]


def require_text(names: Iterable[str]) -> None:
    """Raise a DataError for a name that is not UTF-8, which the JSON files and pages written after training could not hold."""
    for name in names:
        if (shown := name.encode(errors="backslashreplace").decode()) != name:
            raise DataError(shown, "name", "must be UTF-8, has another byte", "rename this folder or photo")


def by_stem(paths: Iterable[Path]) -> dict[str, list[Path]]:
    """The files by their names without endings."""
    stems: dict[str, list[Path]] = {}
    for path in paths:
        stems.setdefault(path.stem, []).append(path)
    return stems


def is_file(path: Path) -> bool:
    """Whether the path leads to a file; not for a name that no file can have, such as one of 5,000 letters."""
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises for a name that is too long


def usable(
    listing: Path, entries: Sequence[_Entry], path_of: Callable[[_Entry], Path], *, skip_faulty: bool
) -> list[_Entry]:
    """The entries whose photos can be used, in their order.

    Args:
        listing: the file or folder that lists the photos, for messages.
        skip_faulty: decode every photo, and leave out those that are missing or cannot be decoded, with a warning for each.
            Else no photo is decoded: a damaged one fails when it is loaded.

    Raises:
        DataError: a photo is missing and none may be left out, or none is left.
    """
    absent = [path_of(entry).name for entry in entries if not is_file(path_of(entry))]
    if absent and not skip_faulty:
        problem = f"{len(absent)} of {len(entries)} are not there: {some(absent)}"
        raise DataError(
            listing, "photos", problem, "put them back, or train without them: data.reader.skip_faulty=true"
        )
    kept = [entry for entry in entries if _decodes(path_of(entry))] if skip_faulty else list(entries)
    if entries and not kept:
        raise DataError(listing, "photos", f"none of {len(entries)} can be used", "check the path")
    return kept


def some(names: Sequence[str]) -> str:
    """The first few names, each at most 80 characters of it."""
    shown = [name[:80].encode(errors="backslashreplace").decode() for name in names[:_LISTED]]
    return ", ".join(shown) + (", …" if len(names) > _LISTED else "")


def _decodes(path: Path) -> bool:
    try:
        read_image(path, turn=True)
    except DataError as error:
        _log.warning("skipped: %s", error)
        return False
    return True
