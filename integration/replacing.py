"""One function in place of another in every module that holds it, so that it does not matter how a script imported it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any


class Replaced:
    """A function that has been replaced in all loaded modules, under any name.

    Functions that a module binds later, or holds in another object, are not found; an `Attachment` raises an error if
    its host then renders with the original.
    """

    def __init__(self, original: Callable[..., Any], replacement: Callable[..., Any]) -> None:
        self._original, self._places = original, []  # type: tuple[Any, list[tuple[Any, str]]]
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
