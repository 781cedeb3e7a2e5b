"""The run-time type checker of the tests: beartype, with int accepted where float is asked for, as Python does, and jaxtyping's
sizes: a name has one value in a call.
"""

import dataclasses
import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
_context = jaxtyping.jaxtyped


def checked_once(*, typechecker: Callable[..., Any]) -> Callable[[Any], Any]:
    """Takes the place of `jaxtyping.jaxtyped`, by which jaxtyping's import hook decorates every function and class.

    That one binds the arguments of every call, and checks them before the call and again with the result, for the sake of its
    messages. It takes half of the time of a test of small tensors.
    """

    def decorated(written: Any) -> Any:
        if not inspect.isclass(written):
            return _checked(written, typechecker)
        if dataclasses.is_dataclass(written) and "__init__" in vars(written):
            written.__init__ = _checked(written.__init__, typechecker)
        return written

    return decorated


def _checked(written: Any, typechecker: Callable[..., Any]) -> Any:
    hints = written.__annotations__
    if not hints:
        return written
    written.__annotations__ = {name: _resolved(hint, written.__globals__) for name, hint in hints.items()}
    checked, has_sizes = typechecker(written), "jaxtyping" in repr(written.__annotations__)
    # As written, since settings are checked against them, and pages are made of them.
    written.__annotations__ = checked.__annotations__ = hints
    if not has_sizes:
        return checked

    @wraps(written)
    def called(*arguments: Any, **named: Any) -> Any:
        with _context("context"):
            return checked(*arguments, **named)

    return called


def _resolved(hint: Any, names: dict[str, Any]) -> Any:
    """The type that a text names. Any for one that is imported for type checkers alone, and for a class that is being made."""

    def of(value: hint) -> None: ...  # type: ignore[valid-type]

    try:
        return get_type_hints(of, names, include_extras=True)["value"]
    except Exception:  # of whatever kind, as jaxtyping does
        return Any
