"""Contexts that replace functions and attributes of a host."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any


@contextmanager
def replaced_attribute(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Give an attribute another value. At the end it has its own again, unless somebody has replaced it since: the end may come
    late, when Python collects an attachment that was never removed.
    """
    original = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if getattr(owner, name, None) is value:
            setattr(owner, name, original)


@contextmanager
def replaced_everywhere(original: Callable[..., Any], replacement: Callable[..., Any]) -> Iterator[None]:
    """Replace a function in all loaded modules, under any name.

    Functions that a module binds later, or holds in another object, are not found; an `Attachment` raises an error if
    its host then renders with the original.
    """
    with ExitStack() as undo:
        for module in list(sys.modules.values()):
            for name, value in list(getattr(module, "__dict__", {}).items()):
                if value is original:
                    undo.enter_context(replaced_attribute(module, name, replacement))
        yield


@contextmanager
def replaced_methods(owner: Any, replacements: Mapping[str, Callable[..., Any]]) -> Iterator[None]:
    """Replace methods of one object. Each replacement gets the original as its first argument. Copies and pickles of the object
    have the original methods.

    Args:
        replacements: by the name of the method; names that the object does not have are ignored.
    """
    names = [name for name in replacements if hasattr(owner, name)]
    for name in names:
        original = getattr(owner, name)
        named = functools.wraps(original, updated=())  # without the attributes of an earlier replacement
        setattr(owner, name, named(_Method(replacements[name], owner, name)))
    try:
        yield
    finally:
        for name in names:
            vars(owner).pop(name, None)


class _Method:
    def __init__(self, replacement: Callable[..., Any], owner: Any, name: str) -> None:
        self._call = functools.partial(replacement, getattr(owner, name))
        self._own = owner, name

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._call(*args, **kwargs)

    def __reduce__(self) -> Any:
        return getattr, self._own
