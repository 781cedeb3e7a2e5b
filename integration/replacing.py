"""Functions in place of a host's own: in every module that holds one, or in one object."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping
from typing import Any


class Replaced:
    """A function that has been replaced in all loaded modules, under any name.

    Functions that a module binds later, or holds in another object, are not found; an `Attachment` raises an error if
    its host then renders with the original.
    """

    def __init__(self, original: Callable[..., Any], replacement: Callable[..., Any]) -> None:
        self._original = original
        self._places: list[tuple[Any, str]] = []
        for module in list(sys.modules.values()):
            for name, value in list(vars(module).items()) if hasattr(module, "__dict__") else ():
                if value is original:
                    setattr(module, name, replacement)
                    self._places.append((module, name))

    def undo(self) -> None:
        """Put the original back."""
        for module, name in self._places:
            setattr(module, name, self._original)
        self._places.clear()


class ReplacedMethods:
    """Methods of one object that have been replaced; each replacement gets the original as its first argument.

    Args:
        replacements: by the name of the method. Those that the object does not have are left out.
    """

    def __init__(self, owner: Any, replacements: Mapping[str, Callable[..., Any]]) -> None:
        self._owner = owner
        self._names = [name for name in replacements if hasattr(owner, name)]
        for name in self._names:
            original = getattr(owner, name)
            setattr(owner, name, functools.wraps(original)(functools.partial(replacements[name], original)))

    def undo(self) -> None:
        """Give the object the methods of its class."""
        for name in self._names:
            vars(self._owner).pop(name, None)
