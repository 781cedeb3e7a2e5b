"""JSON from strangers: no NaN, no key twice, no bottomless nesting, no number too long to be one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from clear_strategies.errors import DataError

_LARGEST: Final = 256 << 20


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        DataError: it cannot be read, is not JSON in the strict sense, or is no object.
    """

    def refuse_constant(name: str) -> Any:
        raise ValueError(f"{name} is no JSON number")

    def refuse_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) != len(pairs):
            raise ValueError("a key occurs twice in one object")
        return dict(pairs)

    try:
        if path.stat().st_size > _LARGEST:
            raise DataError(path, "size", f"is more than {_LARGEST >> 20} MiB", "check the path")
        value = json.loads(path.read_bytes(), parse_constant=refuse_constant, object_pairs_hook=refuse_twice)
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
        DataError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e18:
        raise DataError(path, where, f"is {str(value)[:40]!r} where a finite number belongs", "correct the field")
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
