"""Proxies, for recorded work, of values that differ between replays: the iteration, and a view's name and camera.

A replay repeats what Python has decided by such a value. A comparison with the iteration becomes a guard of the recording, which
no longer holds at an iteration at which the result differs. Any other read of a proxy ends the recording with an error.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Collection
from typing import Any, Final, TypeVar, cast

from torch import Tensor

from rasterizers.recording import running
from rasterizers.torch_internals import tree_leaves

R = TypeVar("R")


class Unread:
    """A value that recorded work must not read.

    Args:
        what: its name, for the error.
        but: attributes that may be read, since they are the same in every replay.
    """

    def __init__(self, value: Any, what: str, but: Collection[str] = ()) -> None:
        self._value, self._what, self._but = value, what, but

    @property  # type: ignore[misc]  # for isinstance, which type checks ask
    def __class__(self) -> Any:
        return type(self._value)

    def __str__(self) -> str:
        """Refused in a recording, where it might become a seed or a key; allowed afterwards, e.g. in a message."""
        if running() is not None:
            self._refuse()
        return str(self._value)

    __repr__ = __str__

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._value, name) if name in self._but else self._refuse()

    def _refuse(self, *_: Any) -> Any:
        raise RuntimeError(f"recorded work must not read {self._what}, which is another one in a replay.")

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        next(x for x in tree_leaves((args, kwargs)) if isinstance(x, cls))._refuse()


class Guarded(Unread):
    """The iteration t, or a number computed from it. Each comparison becomes a guard of the recording. It cannot become a
    plain number, which a replay would repeat.

    Args:
        at: the number as a function of t.
    """

    def __init__(self, value: Any, what: str, at: Callable[[int], Any] = lambda t: t) -> None:
        super().__init__(value, what)
        self.at = at

    def _made(self, by: Callable[..., Any], *other: Any) -> Guarded:
        return Guarded(by(self._value, *other), self._what, lambda t: by(self.at(t), *other))

    def _answered(self, by: Callable[..., bool], *other: Any) -> bool:
        answer, of = by(self._value, *other), self.at
        if (recording := running()) is not None:
            recording.guards.append(lambda t: by(of(t), *other) == answer)
        return answer

    def __bool__(self) -> bool:
        return self._answered(bool)


def _method(how: Callable[..., Any], by: Callable[..., Any], *, reflected: bool = False) -> Callable[..., Any]:
    """The method that Python calls for the operator `by`.

    Args:
        how: `Guarded._made` or `Guarded._answered`.
    """

    def called(self: Guarded, *other: Any) -> Any:
        if any(isinstance(x, (Unread, Tensor)) for x in other):  # a tensor would store this number
            self._refuse()
        return how(self, (lambda x, y: by(y, x)) if reflected else by, *other)

    return called


_TWO: Final = ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow")
_ONE: Final = ("neg", "pos", "abs")
_COMPARED: Final = ("eq", "ne", "lt", "le", "gt", "ge")
_READ: Final = ("bool", "int", "float", "complex", "index", "hash", "len", "iter", "getitem", "contains")
for _name in (*_READ, *_COMPARED, *_ONE, *_TWO, *(f"r{name}" for name in _TWO)):
    setattr(Unread, f"__{_name}__", Unread._refuse)
for _name in (*_ONE, *_TWO):
    setattr(Guarded, f"__{_name}__", _method(Guarded._made, getattr(operator, _name)))
for _name in _TWO:
    setattr(Guarded, f"__r{_name}__", _method(Guarded._made, getattr(operator, _name), reflected=True))
for _name in _COMPARED:
    setattr(Guarded, f"__{_name}__", _method(Guarded._answered, getattr(operator, _name)))


def iteration(t: int) -> int:
    """The iteration; a proxy of it in a recording."""
    return t if running() is None else cast(int, Guarded(t, "the iteration"))


def unread(value: R, what: str, but: Collection[str] = ()) -> R:
    """The value; in a recording, which must not read it, a proxy of it, see `Unread`."""
    return value if running() is None else cast(R, Unread(value, what, but))
