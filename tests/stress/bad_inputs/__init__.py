"""Named bad inputs, as tables: each is refused in one line that names the file or the setting.

`inputs()` lists them all, and a test runs each of them by its name.
"""

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clear_strategies.errors import ClearError, DataError
from clear_strategies.jobs import exit_codes
from tests.helpers.image_files import png
from tests.stress.rows import Row, failures


@dataclass(frozen=True)
class BadInput:
    """An input with one defect.

    Args:
        surface: what takes it, e.g. "PLY". name: the defect.
        give: makes it in an empty folder and gives it to the program, which must refuse it.
        pattern: regular expression that the message must match.
    """

    surface: str
    name: str
    give: Callable[[Path], object]
    pattern: str

    @property
    def id(self) -> str:
        return f"{self.surface}: {self.name}"


def bomb(width: int, height: int) -> bytes:
    """A PNG of a few bytes whose header promises width x height pixels."""
    return png(width, height, 8, 2, b"\0")


class Canary:
    """Unpickling it creates a folder, which `problem` looks for."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def at(
    name: str, read: Callable[[Path], object], make: bytes | Callable[[Path], object] | None = None
) -> Callable[[Path], object]:
    """Reads a path of this name, where `make` has made something, or where there is a file that holds these bytes."""

    def give(folder: Path) -> object:
        path = folder / name
        if isinstance(make, bytes):
            path.write_bytes(make)
        elif make is not None:
            make(path)
        return read(path)

    return give


def a_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def inputs() -> Iterator[BadInput]:
    """All of them."""
    from tests.stress.bad_inputs import checkpoints, folders, images, networks, plys, scenes, settings

    for module in (scenes, plys, images, checkpoints, settings, networks, folders):
        yield from module.INPUTS


def problem(given: BadInput, folder: Path) -> str | None:
    """What is wrong with the refusal; None: nothing."""
    try:
        given.give(folder)
    except Exception as error:
        if (ending := exit_codes.describe(error)) is None or ending.code != exit_codes.UNUSABLE:
            return f"{type(error).__name__}: {error}"
        message = str(error) if isinstance(error, ClearError) else ending.message
        if isinstance(error, DataError) and not all((error.file, error.field, error.problem, error.remedy)):
            return f"the message lacks file, field, problem or remedy: {message}"
    else:
        return "it is accepted"
    if list(folder.rglob("canary")):
        return "code in it was run"
    if "\n" in message:
        return f"the message has several lines: {message}"
    return None if re.search(given.pattern, message) else f"the message says something else: {message}"


def measure(folder: Path) -> Row:
    """How many inputs are not refused as they should be."""

    def outcomes() -> Iterator[tuple[str, str | None]]:
        for i, given in enumerate(inputs()):
            here = folder / str(i)
            here.mkdir()
            yield given.id, problem(given, here)

    return failures(outcomes(), "bad inputs: not refused in one line", "all")
