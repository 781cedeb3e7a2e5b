"""JSON files read strictly: NaN, duplicate keys, deep nesting and numbers beyond a float are refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final

from clear_strategies.errors import DataError
from clear_strategies.files import require_regular

_LARGEST: Final = 256 << 20


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        DataError: it cannot be read, is no strict JSON, or is no object.
    """

    def refuse_constant(name: str) -> Any:
        raise ValueError(f"{name} is no JSON number")

    def finite(digits: str) -> float:
        value = float(digits)
        if not math.isfinite(value):
            raise ValueError(f"{digits[:40]} is beyond the range of a float")
        return value

    def refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        value = dict(pairs)
        if len(value) != len(pairs):
            keys = [key for key, _ in pairs]
            raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} occurs twice in one object")
        return value

    require_regular(path, most=_LARGEST)
    try:
        value = json.loads(
            path.read_text("utf-8"),
            parse_constant=refuse_constant,
            parse_float=finite,
            object_pairs_hook=refuse_duplicates,
        )
    except OSError as error:
        raise DataError(path, "file", f"cannot be read ({error.strerror})", "check the path") from error
    except RecursionError as error:
        raise DataError(path, "json", "is nested too deeply", "write it again") from error
    except ValueError as error:
        raise DataError(path, "json", f"is not valid ({str(error)[:120]})", "write it again") from error
    if not isinstance(value, dict):
        raise DataError(path, "json", f"is a {type(value).__name__}, not an object", "give a transforms file")
    return value


def number(path: Path, where: str, value: Any) -> float:
    """A finite number.

    Raises:
        DataError: it is no number, or missing.
    """
    if value is None:
        raise DataError(path, where, "is missing", "give a number")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e18:
        found = repr(value)[:40] if isinstance(value, str | int | float) else f"a {type(value).__name__}"
        raise DataError(path, where, f"is {found} where a finite number belongs", "correct the field")
    return float(value)


def frames_of(path: Path, content: dict[str, Any]) -> list[dict[str, Any]]:
    """The list "frames", each an object.

    Raises:
        DataError: it is missing, empty, or holds something else.
    """
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(path, "frames", "is missing, empty or no list of objects", "give a transforms file")
    return frames


def file_path(path: Path, index: int, frame: dict[str, Any]) -> str:
    """A frame's "file_path".

    Raises:
        DataError: it is missing or no text.
    """
    value = frame.get("file_path")
    if not isinstance(value, str) or not value:
        raise DataError(path, f"frames[{index}].file_path", "is missing or no text", "name the frame's image")
    return value
