"""Named bad inputs, as tables: each is refused in one line that names the file or the setting.

`inputs()` lists them all; a test runs each of them by its name, and `python -m tests.stress` counts them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from clear_strategies.errors import ClearError, DataError
from clear_strategies.jobs import exit_codes
from tests.stress.rows import Row, Worst


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
    if "\n" in message:
        return f"the message has several lines: {message}"
    return None if re.search(given.pattern, message) else f"the message says something else: {message}"


def measure(folder: Path) -> list[Row]:
    """One row per surface: how many inputs are not refused as they should be."""
    found: dict[str, Worst] = {}
    for i, given in enumerate(inputs()):
        here = folder / str(i)
        here.mkdir(parents=True)
        found.setdefault(given.surface, Worst()).add(float(problem(given, here) is not None), given.name)
    return [worst.row(f"bad {surface}: not refused in one line", "all", 0) for surface, worst in found.items()]
