"""JSON files, validated against msgspec types, which ignore unknown keys: `typed(path, read_object(path), Run)`.

A file is data: a configuration that is read from one passes `plain_settings`, and nothing that it names is imported or called.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import msgspec
from msgspec import Meta

from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes

Count = Annotated[int, Meta(ge=0, le=10**12)]
Positive = Annotated[float, Meta(ge=0, lt=1e300)]
Number = Annotated[float, Meta(gt=-1e18, lt=1e18)]

_LARGEST: Final = 256 << 20
_T = TypeVar("_T")


def read(path: Path) -> Any:
    """Parse a file; a DataError if it is not valid JSON, as with NaN or a number beyond the range of a float."""
    try:
        data = read_bytes(path, most=_LARGEST)
        text = data.decode(json.detect_encoding(data))  # some editors write a byte order mark, or UTF-16
        return msgspec.json.decode(text)
    except RecursionError as error:
        raise DataError(path, "json", "is nested too deeply", "write it again") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise DataError(path, "json", f"is not valid ({error})", "write it again") from error


def read_object(path: Path) -> dict[str, Any]:
    """Parse a file that contains a JSON object."""
    value = read(path)
    if not isinstance(value, dict):
        raise DataError(path, "json", f"is a {type(value).__name__}, not an object", "give another file")
    return value


def typed(
    path: Path, content: Any, kind: Callable[..., _T], *, where: str = "", remedy: str = "correct the field"
) -> _T:
    """Convert content, which stands at `where` in the file, to `kind`: a struct, or a list or dict of structs.

    Raises:
        DataError: a value has another type; the field is named as in `frames[1].fl_x`.
    """
    try:
        value: _T = msgspec.convert(content, kind)
        return value
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$")
        missing = re.fullmatch(r"Object missing required field `(.*)`", problem)
        parts = (where, place.strip("`."), missing[1] if missing else "")
        rule = "is missing" if missing else problem.replace("Expected", "must be")
        raise DataError(path, ".".join(filter(None, parts)).replace(".[", "[") or "json", rule, remedy) from error


def plain_settings(path: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """Check a run's configuration from a file: numbers, text, true, false, null and lists of these, by dotted keys.

    A table is refused, since `clear_strategies.settings.build` would call what its `_target_` names. Code that builds an object
    from these values takes the class from an installed package or from the user's command, never from the file.

    Raises:
        DataError: a value is or holds a table.
    """
    for key, value in config.items():
        if not _is_plain(value):
            problem = "must be a number, text, true, false, null or a list of these, and holds a table, which could name a call"
            raise DataError(path, f"config.{key}", problem, "this program writes no such file: do not use it")
    return dict(config)


def _is_plain(value: Any) -> bool:
    return all(map(_is_plain, value)) if isinstance(value, list) else not isinstance(value, dict)
