"""The rows of a run's history: the newest are dicts, the others are packed, a tenth as large; and the tensors of a checkpoint."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from typing import Final, overload

import torch
from jaxtyping import Float64, Int32
from torch import Tensor

from clear_strategies.core.deferred import Number

_LOOSE: Final = 64  # rows at the end that stay dicts and may change


class History(Sequence[dict[str, Number]]):
    """One row per iteration. The last 64 rows may be changed in place; an earlier one is read as a copy.

    Rows have few sets of names, so each set is stored once and a row is its numbers. A row with a number that is still on a
    device stays a dict until that is read.
    """

    def __init__(self, rows: Iterable[dict[str, Number]] = ()) -> None:
        self._names: list[tuple[str, ...]] = []  # the sets of names
        self._kinds, self._ends, self._numbers = array("H"), array("Q"), array("d")
        self._loose: list[dict[str, Number]] = []
        for row in rows:
            self.append(row)

    def append(self, row: dict[str, Number]) -> None:
        self._loose.append(row)
        while len(self._loose) > _LOOSE and all(isinstance(x, float) for x in self._loose[0].values()):
            self._pack(self._loose.pop(0))

    def _pack(self, row: dict[str, Number]) -> None:
        names = tuple(row)
        if names not in self._names:
            self._names.append(names)
        self._kinds.append(self._names.index(names))
        self._numbers.extend(float(x) for x in row.values())  # type: ignore[arg-type]
        self._ends.append(len(self._numbers))

    def __len__(self) -> int:
        return len(self._kinds) + len(self._loose)

    @overload
    def __getitem__(self, at: int) -> dict[str, Number]: ...
    @overload
    def __getitem__(self, at: slice) -> list[dict[str, Number]]: ...
    def __getitem__(self, at: int | slice) -> dict[str, Number] | list[dict[str, Number]]:
        if isinstance(at, slice):
            return [self[i] for i in range(*at.indices(len(self)))]
        if not -len(self) <= at < len(self):
            raise IndexError(f"row {at} of {len(self)}")
        at %= len(self)
        packed = len(self._kinds)
        if at >= packed:
            return self._loose[at - packed]
        end, names = self._ends[at], self._names[self._kinds[at]]
        return dict(zip(names, self._numbers[end - len(names) : end], strict=True))


def packed(rows: Iterable[dict[str, float]]) -> tuple[list[list[str]], Int32[Tensor, " T"], Float64[Tensor, " N"]]:
    """Rows for a file: the sets of names that occur, which of them each row has, and all numbers one after the other."""
    sets, kinds, numbers = dict[tuple[str, ...], int](), array("i"), array("d")
    for row in rows:
        kinds.append(sets.setdefault(tuple(row), len(sets)))
        numbers.extend(row.values())
    return (
        [list(names) for names in sets],
        torch.tensor(kinds, dtype=torch.int32),
        torch.tensor(numbers, dtype=torch.float64),
    )


def unpacked(
    sets: Sequence[Sequence[str]], kinds: Int32[Tensor, " T"], numbers: Float64[Tensor, " N"]
) -> list[dict[str, float]]:
    """The rows that `packed` was given.

    Raises:
        ValueError: the three do not belong together.
    """
    names = [sets[kind] if 0 <= kind < len(sets) else () for kind in kinds.tolist()]
    if sum(map(len, names)) != len(numbers):
        raise ValueError(f"the history has {len(numbers)} numbers for {sum(map(len, names))} names")
    left = iter(numbers.tolist())
    return [{name: next(left) for name in row} for row in names]
