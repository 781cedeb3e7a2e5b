"""Which photos of a capture can be used: files that are missing or damaged are refused together, or skipped and counted."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal, TypeVar, get_args

from clear_strategies.core.checks import require_choice
from clear_strategies.data.photo_files import read_image
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

Fault = Literal["refuse", "skip"]
"""What happens to a capture with faulty photos: it is refused, or goes on without them."""

_Entry = TypeVar("_Entry")
_NAMED: Final = 5  # of many, in a message


def require_faults(missing: Fault, broken: Fault) -> None:
    """Raise a SettingError unless the two settings of every reader are refuse or skip."""
    require_choice("data.missing", missing, get_args(Fault))
    require_choice("data.broken", broken, get_args(Fault))


def usable(
    file: Path, entries: Sequence[_Entry], path_of: Callable[[_Entry], Path], *, missing: Fault, broken: Fault
) -> list[_Entry]:
    """The entries whose photos can be used, in their order.

    Args:
        file: names the photos, for messages.
        missing: refuse or skip entries whose photo is not there.
        broken: skip entries whose photo cannot be decoded, which decodes all of them; refuse leaves that to whoever reads them.

    Raises:
        DataError: a photo is missing and refused, or none is left.
    """
    require_faults(missing, broken)
    there = [entry for entry in entries if path_of(entry).is_file()]
    if absent := [path_of(entry).name for entry in entries if not path_of(entry).is_file()]:
        told = f"{len(absent)} of {len(entries)} are not there: {some(absent)}"
        if missing == "refuse":
            raise DataError(file, "photos", told, "put them back, or train without them: data.missing=skip")
        _log.warning("%s: %s. They are skipped.", file, told)
    if broken == "skip":
        there = [entry for entry in there if _decodes(path_of(entry))]
    if entries and not there:
        raise DataError(file, "photos", f"none of {len(entries)} can be used", "check the path")
    return there


def some(names: Sequence[str]) -> str:
    """The first few names."""
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")


def _decodes(path: Path) -> bool:
    try:
        read_image(path, turn=True)
    except DataError as error:
        _log.warning("skipped: %s", error)
        return False
    return True
