"""Functions and attributes in place of a host's own."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any


def replace_everywhere(original: Callable[..., Any], replacement: Callable[..., Any]) -> Callable[[], None]:
    """Replace a function in all loaded modules, under any name; returns what undoes it.

    Functions that a module binds later, or holds in another object, are not found; an `Attachment` raises an error if
    its host then renders with the original.
    """
    places = [
        (module, name)
        for module in list(sys.modules.values())
        for name, value in list(getattr(module, "__dict__", {}).items())
        if value is original
    ]

    def put(function: Callable[..., Any]) -> None:
        for module, name in places:
            setattr(module, name, function)

    put(replacement)
    return functools.partial(put, original)


def replace_methods(owner: Any, replacements: Mapping[str, Callable[..., Any]]) -> Callable[[], None]:
    """Replace methods of one object; returns what undoes it. Each replacement gets the original as its first argument. Copies and
    pickles of the object have its own methods.

    Args:
        replacements: by the name of the method. Those that the object does not have are left out.
    """
    names = [name for name in replacements if hasattr(owner, name)]
    for name in names:
        original = getattr(owner, name)
        named = functools.wraps(original, updated=())  # the attributes of a method that was replaced before are its own
        setattr(owner, name, named(_Method(replacements[name], owner, name)))

    def undo() -> None:
        for name in names:
            vars(owner).pop(name, None)

    return undo


class _Method:
    def __init__(self, replacement: Callable[..., Any], owner: Any, name: str) -> None:
        self._call = functools.partial(replacement, getattr(owner, name))
        self._own = owner, name

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._call(*args, **kwargs)

    def __reduce__(self) -> Any:
        return getattr, self._own


@contextmanager
def replaced_attribute(owner: Any, name: str, value: Any) -> Iterator[None]:
    """The attribute has another value inside the context."""
    original = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, original)
