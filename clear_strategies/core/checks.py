"""Refusing settings. Each message names the setting, the rule, the value that was found, and what to write instead."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from numbers import Real
from typing import Any, NoReturn, TypeGuard

from clear_strategies.errors import SettingError
from rasterizers.interface import Color


def require_whole(name: str, value: object, *, least: int, most: int | None = None) -> None:
    """Raise a SettingError unless it is a whole number in [`least`, `most`]; a float such as 2.5 or 4.0 and a bool are none."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        refuse(name, f"must be a whole number of at least {least}", value, f"{name}={max(least, 1)}")
    elif most is not None and value > most:
        refuse(name, f"must be a whole number of at most {most}", value, f"{name}={most}")


def require_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    least: float = 0,
    most: float = math.inf,
    below: float = math.inf,
) -> None:
    """Raise a SettingError unless it is a finite number: > `above`, or else >= `least`; <= `most`, and < `below`."""
    low, opening, sign = (least, "[", ">=") if above is None else (above, "(", ">")
    number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    if (number > low or (number == low and above is None)) and number <= most and number < below:
        return
    if math.isfinite(most):
        nearest = most if number > most else low if above is None else min(most, low + 1)
        refuse(name, f"must lie in {opening}{low:g}, {most:g}]", value, f"{name}={nearest:g}")
    if math.isfinite(below):
        refuse(name, f"must lie in {opening}{low:g}, {below:g})", value, f"{name}={(low + below) / 2:g}")
    refuse(name, f"must be a finite number {sign} {low:g}", value, f"{name}={low + 1:g}")


def require_choice(name: str, value: object, choices: Collection[object]) -> None:
    """Raise a SettingError unless it is one of `choices`."""
    if value not in choices:
        listed = ", ".join(str(choice) for choice in choices)
        refuse(name, f"must be one of {listed}", value, f"{name}={next(iter(choices))}")


def as_color(name: str, value: object) -> Color:
    """Three numbers in [0, 1], as a tuple; a SettingError if it is something else."""
    if not is_color(value):
        refuse(name, "must be three numbers in [0, 1], an RGB colour", value, f"{name}=[1,1,1] is white")
    r, g, b = map(float, value)
    return r, g, b


def is_color(value: object) -> TypeGuard[Sequence[Any]]:
    """Return True if the value is three numbers in [0, 1]."""
    parts = value if isinstance(value, list | tuple) else ()
    return len(parts) == 3 and all(isinstance(x, Real) and 0 <= float(x) <= 1 for x in parts)


def refuse(name: str, rule: str, value: object, remedy: str) -> NoReturn:
    """Raise a SettingError."""
    raise SettingError(f"{name}: {rule}, got {value!r}: {remedy}")
