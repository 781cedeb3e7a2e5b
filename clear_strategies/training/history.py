"""The rows of a run's history: the newest are dicts, the others lie in columns, a tenth as large."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Sequence
from typing import Final, overload

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number

_LOOSE: Final = 64  # rows at the end that stay dicts and may change


class History(Sequence[dict[str, Number]]):
    """One row per iteration. The last 64 rows may be changed in place; an earlier one is read as a copy, without its NaNs.

    A row with a number that is still on a device stays a dict until that is read.
    """

    def __init__(self, rows: Iterable[dict[str, Number]] = ()) -> None:
        self._columns: dict[str, array[float]] = {}
        self._packed, self._loose = 0, list[dict[str, Number]]()
        for row in rows:
            self.append(row)

    def append(self, row: dict[str, Number]) -> None:
        self._loose.append(row)
        while len(self._loose) > _LOOSE and not any(deferred.is_unread(x) for x in self._loose[0].values()):
            oldest = self._loose.pop(0)
            for name in oldest:
                if name not in self._columns:
                    self._columns[name] = array("d", [math.nan]) * self._packed
            for name, column in self._columns.items():
                column.append(oldest.get(name, math.nan))  # type: ignore[arg-type]
            self._packed += 1

    def __len__(self) -> int:
        return self._packed + len(self._loose)

    @overload
    def __getitem__(self, at: int) -> dict[str, Number]: ...
    @overload
    def __getitem__(self, at: slice) -> list[dict[str, Number]]: ...
    def __getitem__(self, at: int | slice) -> dict[str, Number] | list[dict[str, Number]]:
        if isinstance(at, slice):
            return [self[i] for i in range(*at.indices(len(self)))]
        at = range(len(self))[at]
        if at >= self._packed:
            return self._loose[at - self._packed]
        return {name: column[at] for name, column in self._columns.items() if not math.isnan(column[at])}
