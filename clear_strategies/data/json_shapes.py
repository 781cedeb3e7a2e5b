"""What a JSON file of a run must hold: shapes that are checked before anything is read out of it.

    RUN = record(iterations=whole(1), strategies=each(text()), scores=table(number(null=True)))
    require(path, content, RUN, remedy="train the run again")

The first value that does not fit is refused with its place, e.g. `scores.psnr`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from clear_strategies.errors import DataError

LARGEST: Final = 10**12  # a whole number beyond it counts nothing here


class Unfit(ValueError):
    """A value that does not fit: where it stands, and what is wrong with it."""

    def __init__(self, where: str, problem: str) -> None:
        self.where, self.problem = where, problem
        super().__init__(f"{where}: {problem}")


Shape = Callable[[str, Any], None]
"""Called with the place and the value; raises `Unfit`."""


def require(path: Path, content: Any, shape: Shape, remedy: str) -> None:
    """Check a file's content.

    Raises:
        DataError: names the file, the place in it, what is wrong, and the remedy.
    """
    try:
        shape("", content)
    except Unfit as unfit:
        raise DataError(path, unfit.where or "json", unfit.problem, remedy) from unfit


def anything(where: str, value: Any) -> None:
    """Any value."""


def whole(least: int = 0, most: int = LARGEST) -> Shape:
    """A whole number in [least, most]; a float without a fraction is one."""

    def shape(where: str, value: Any) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1:  # NaN is unequal
            raise Unfit(where, f"must be a whole number, got {_shown(value)}")
        if not least <= value <= most:
            raise Unfit(where, f"must lie in [{least}, {most}], got {_shown(value)}")

    return shape


def number(*, least: float = -math.inf, null: bool = False) -> Shape:
    """A finite number of at least `least`; `null` stands for one that was not finite."""

    def shape(where: str, value: Any) -> None:
        if null and value is None:
            return
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
            raise Unfit(where, f"must be a finite number, got {_shown(value)}")
        if value < least:
            raise Unfit(where, f"must be at least {least:g}, got {_shown(value)}")

    return shape


def real(where: str, value: Any) -> None:
    """A number, which may be NaN or infinite where the file's JSON has these."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Unfit(where, f"must be a number, got {_shown(value)}")


def text(*, null: bool = False) -> Shape:
    """A string."""

    def shape(where: str, value: Any) -> None:
        if not (isinstance(value, str) or (null and value is None)):
            raise Unfit(where, f"must be text, got {_shown(value)}")

    return shape


def flag(where: str, value: Any) -> None:
    """True or false."""
    if not isinstance(value, bool):
        raise Unfit(where, f"must be true or false, got {_shown(value)}")


def one_of(*choices: str) -> Shape:
    """One of these strings."""

    def shape(where: str, value: Any) -> None:
        if value not in choices:
            raise Unfit(where, f"must be one of {', '.join(choices)}, got {_shown(value)}")

    return shape


def each(entry: Shape) -> Shape:
    """A list, each entry of the shape."""

    def shape(where: str, value: Any) -> None:
        if not isinstance(value, list):
            raise Unfit(where, f"must be a list, got {_shown(value)}")
        for i, item in enumerate(value):
            entry(f"{where}[{i}]", item)

    return shape


def table(entry: Shape) -> Shape:
    """An object with any keys, each value of the shape."""

    def shape(where: str, value: Any) -> None:
        for key, item in _object(where, value).items():
            entry(f"{where}.{key}" if where else key, item)

    return shape


def record(optional: Mapping[str, Shape] | None = None, **required: Shape) -> Shape:
    """An object with these keys; others are allowed and not looked at."""
    may = optional or {}

    def shape(where: str, value: Any) -> None:
        content = _object(where, value)
        for key, field in {**required, **may}.items():
            place = f"{where}.{key}" if where else key
            if key in content:
                field(place, content[key])
            elif key in required:
                raise Unfit(place, "is missing")

    return shape


def _object(where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise Unfit(where, f"must be an object, got {_shown(value)}")
    return value


def _shown(value: Any) -> str:
    return repr(value)[:60] if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
