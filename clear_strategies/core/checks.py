"""Refusing settings. Each message names the setting, the rule, the value that was found, and what to write instead."""

from __future__ import annotations

import math
from collections.abc import Collection

from clear_strategies.errors import SettingError
from rasterizers.interface import Color


def require_whole(name: str, value: object, *, least: int, most: int | None = None) -> None:
    """A whole number of at least `least` and at most `most`; a float such as 2.5 or 4.0 and a bool are none.

    Raises:
        SettingError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        refuse(name, f"must be a whole number of at least {least}", value, f"{name}={max(least, 1)}")
    elif most is not None and value > most:
        refuse(name, f"must be a whole number of at most {most}", value, f"{name}={most}")


def require_number(
    name: str, value: object, *, above: float | None = None, least: float | None = None, most: float = math.inf
) -> None:
    """A finite number, greater than `above` or at least `least`, and at most `most`.

    Raises:
        SettingError: it is not.
    """
    low = -math.inf if least is None else least
    fits = (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
        and low <= value <= most
        and (above is None or value > above)
    )
    if not fits:
        limits = [f"> {above:g}"] if above is not None else [f">= {low:g}"] if least is not None else []
        limits += [f"<= {most:g}"] if math.isfinite(most) else []
        rule = " and ".join(["must be a finite number", *limits])
        refuse(name, rule, value, f"{name}={most if math.isfinite(most) else max(low, above or 0, 0) + 1:g}")


def require_choice(name: str, value: object, choices: Collection[object]) -> None:
    """One of `choices`.

    Raises:
        SettingError: it is not.
    """
    if value not in choices:
        listed = ", ".join(str(choice) for choice in choices)
        refuse(name, f"must be one of {listed}", value, f"{name}={next(iter(choices))}")


def as_color(name: str, value: object) -> Color:
    """Three numbers in [0, 1], as a tuple.

    Raises:
        SettingError: it is something else.
    """
    parts = [float(x) for x in value if isinstance(x, int | float)] if isinstance(value, list | tuple) else []
    if not isinstance(value, list | tuple) or len(value) != 3 or len(parts) != 3 or not all(0 <= x <= 1 for x in parts):
        refuse(name, "must be three numbers in [0, 1], an RGB colour", value, f"{name}=[1,1,1] is white")
    return parts[0], parts[1], parts[2]


def refuse(name: str, rule: str, value: object, remedy: str) -> None:
    """Raise the error.

    Raises:
        SettingError: always.
    """
    raise SettingError(f"{name}: {rule}, got {value!r}: {remedy}")
