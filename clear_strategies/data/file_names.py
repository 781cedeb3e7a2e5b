"""Comparison of file names, and lookup of the files that a capture names."""

from __future__ import annotations

import functools
import os
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PureWindowsPath
from typing import Final

from clear_strategies.data.photo_files import SUFFIXES
from clear_strategies.errors import DataError

LISTED: Final = 5
"""The most names in a message."""


def normalized(name: str) -> str:
    """Return the name in Unicode's form NFC; zip files from a Mac have names in form NFD, which look the same."""
    return unicodedata.normalize("NFC", name)


def name_key(name: str) -> str:
    """Return a key that is equal for names that differ only in case and in Unicode's form."""
    return normalized(name).lower()


def named(folder: Path, name: str) -> Path:
    """Return the path of a folder's entry whose name has the same `name_key`; `folder / name` if there is none."""
    path = folder / name
    if path.exists() or not folder.is_dir():
        return path
    wanted = name_key(name)
    return next((folder / other for other in sorted(os.listdir(folder)) if name_key(other) == wanted), path)  # noqa: PTH208 - faster


def finder(folder: Path) -> Callable[[str], Path]:
    """Return a function that finds the files that a capture names, in or below a folder.

    A name is first used literally, then with ".png" appended. If there is no such file, backslashes separate folders, only the
    `name_key` of each name counts, leading folders of an absolute path are ignored, the folder's own name may come first, and the
    suffix may differ if only one image has that stem. If nothing is found, the returned path does not exist.
    """
    subfolder = functools.cache(named)

    @functools.cache
    def entries(parent: Path) -> dict[str, list[Path]]:
        """The entries of a folder by `name_key` of their names, images also by that of their stems."""
        found: dict[str, list[Path]] = {}
        for path in sorted(parent.iterdir()) if parent.is_dir() else ():
            for key in {name_key(path.name), name_key(path.stem if path.suffix.lower() in SUFFIXES else path.name)}:
                found.setdefault(key, []).append(path)
        return found

    def below(parts: Sequence[str]) -> Path | None:
        parent, last = functools.reduce(subfolder, parts[:-1], folder), PureWindowsPath(parts[-1])
        for key in (last.name, last.stem) if last.suffix[1:2].isalpha() else (last.name,):  # "rgb.0001" has no ending
            files = [path for path in entries(parent).get(name_key(key), []) if path.is_file()]
            if len(files) == 1:
                return files[0]
        return None

    def find(name: str) -> Path:
        for exact in (folder / name, folder / f"{name}.png"):
            if is_file(exact):
                inside = folder.absolute()
                return folder / exact.relative_to(inside) if exact.is_relative_to(inside) else exact
        path = PureWindowsPath(name)
        parts = [part for part in path.parts if part != path.anchor]
        twice = len(parts) > 1 and name_key(parts[0]) == name_key(folder.absolute().name)
        starts = range(len(parts) if path.anchor else min(1 + twice, len(parts)))
        missing = folder.joinpath(*(parts[-1:] if path.anchor else parts))
        return next(filter(None, (below(parts[i:]) for i in starts)), missing)

    return find


def names_below(paths: Sequence[Path]) -> list[str]:
    """Return the paths relative to the deepest folder that contains all of them."""
    shared = os.path.commonprefix([path.parent.parts for path in paths])  # noqa: RUF071 - compares tuples of folders
    return ["/".join(path.parts[len(shared) :]) for path in paths]


def is_file(path: Path) -> bool:
    """Return True if the path is a file; False for a name that no file can have, such as one of 5,000 letters."""
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises for a name that is too long


def require_text(names: Iterable[str]) -> None:
    """Raise a DataError for a name with a control character, such as a line break, or that is not UTF-8: the JSON files and pages
    written after training could not contain it.
    """
    for name in names:
        if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
            shown, rule = repr(name)[1:-1], "must be UTF-8 without control characters"
            raise DataError(shown, "name", rule, "rename this folder or photo")


def some(names: Sequence[str]) -> str:
    """Join the first `LISTED` names, each cut to 80 characters."""
    shown = [name[:80].encode(errors="backslashreplace").decode() for name in names[:LISTED]]
    return ", ".join(shown) + (", …" if len(names) > LISTED else "")
