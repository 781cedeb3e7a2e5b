"""The photos of a folder or a capture: where they are, which can be used, and names that may not lead elsewhere."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeVar, get_args

from clear_strategies.core.checks import as_color, require_choice
from clear_strategies.data.photo_files import SUFFIXES, read_image
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_FOLDERS: Final = ("images", "images_2", "images_4", "images_8")
_LONGEST_NAME: Final = 1024
_LONGEST_PART: Final = 255  # bytes
_LISTED: Final = 5  # names in a message, at most

Fault = Literal["refuse", "skip"]
"""A capture with faulty photos is refused, or read without them."""

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


def require_faults(missing: Fault, broken: Fault) -> None:
    """Raise a SettingError unless both are "refuse" or "skip"."""
    require_choice("data.missing", missing, get_args(Fault))
    require_choice("data.broken", broken, get_args(Fault))


@dataclass(frozen=True, slots=True)
class PhotoRules:
    """The arguments that readers share.

    Args:
        background: RGB in [0, 1] behind transparent pixels; None: black.
        allow_outside: follow file names and links that lead out of the folder.
        missing: photos that do not exist: "refuse" or "skip".
        broken: photos that cannot be decoded. "skip" decodes every photo and leaves these out; "refuse" decodes none, so that
            they fail when they are loaded.

    Raises:
        SettingError: a value is none of these.
    """

    background: Color | None = None
    allow_outside: bool = False
    missing: Fault = "refuse"
    broken: Fault = "refuse"

    def __post_init__(self) -> None:
        require_faults(self.missing, self.broken)
        if self.background is not None:
            object.__setattr__(self, "background", as_color("data.reader.background", self.background))

    def inside(self, root: Path, name: str, *, file: Path) -> Path:
        """`root / name`, which must be inside `root` once symbolic links are resolved, unless `allow_outside`.

        Args:
            file: the file that has the name, for messages.

        Raises:
            DataError: the name is absolute or leads out of `root`, or is no file name.
        """
        longest = max(len(part.encode(errors="replace")) for part in name.replace("\\", "/").split("/"))
        if not 0 < len(name) <= _LONGEST_NAME or "\0" in name or longest > _LONGEST_PART:
            problem = f"{name[:80]!r} is no file name"
            raise DataError(file, "file name", problem, "name an image inside the data set's folder")
        if self.allow_outside:
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

    def usable(self, file: Path, entries: Sequence[_Entry], path_of: Callable[[_Entry], Path]) -> list[_Entry]:
        """The entries whose photos can be used, in their order.

        Args:
            file: the file or folder that lists the photos, for messages.

        Raises:
            DataError: a photo is missing and refused, or none is left.
        """
        absent = [path_of(entry).name for entry in entries if not path_of(entry).is_file()]
        if absent:
            problem = f"{len(absent)} of {len(entries)} are not there: {some(absent)}"
            if self.missing == "refuse":
                raise DataError(file, "photos", problem, "put them back, or train without them: data.missing=skip")
            _log.warning("%s: %s. They are skipped.", file, problem)
        kept = [entry for entry in entries if path_of(entry).is_file()]
        if self.broken == "skip":
            kept = [entry for entry in kept if _decodes(path_of(entry))]
        if entries and not kept:
            raise DataError(file, "photos", f"none of {len(entries)} can be used", "check the path")
        return kept


def some(names: Sequence[str]) -> str:
    """The first few names."""
    return ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")


def _decodes(path: Path) -> bool:
    try:
        read_image(path, turn=True)
    except DataError as error:
        _log.warning("skipped: %s", error)
        return False
    return True
