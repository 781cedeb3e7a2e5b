"""Floor 0: numbers that are read late.

What a computation says in one number is a 0-dim tensor. In the CPU's memory it is read at once. On a device reading it would
make the host wait for all that is under way there; so it stays a tensor, what is to be made of it stays a recipe, and whoever
needs numbers reads all that have gathered, in one transfer. What becomes of a number is the same function in both cases:

    error = late.scalar((image - target).square().mean())    # a float on the CPU, elsewhere the tensor itself
    psnr = late.made(decibels, error)                        # decibels(error) on the CPU, elsewhere a recipe
    late.settle(history)                                     # from here on floats, wherever they came from
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Deferred:
    """What `recipe` makes of its parts once they are read; it may also say what it finds."""

    recipe: Callable[..., float]
    parts: tuple[Number, ...]


Scalar = float | Tensor
"""To reckon with: a float, or a 0-dim tensor on a device, which nobody writes to again."""

Number = Scalar | Deferred
"""To be told: in a log, a table, a message."""


def is_immediate(x: Tensor) -> bool:
    """Whether numbers made of x are read where they are made: nobody waits for the CPU's own memory."""
    return x.device.type == "cpu"


def scalar(x: Tensor) -> Scalar:
    """A 0-dim tensor as a number."""
    return float(x) if is_immediate(x) else x


def defer(recipe: Callable[..., float], *numbers: Number) -> Number:
    """recipe(*numbers): now, if all of them are known."""
    if any(isinstance(x, Tensor | Deferred) for x in numbers):
        return Deferred(recipe, numbers)
    return recipe(*numbers)


def read(numbers: Sequence[Number]) -> list[float]:
    """The numbers as floats; all that are on the device come in one transfer."""
    values = _transferred([x for number in numbers for x in _tensors(number)])

    def value(x: Number) -> float:
        if isinstance(x, Deferred):
            return x.recipe(*map(value, x.parts))
        return values[id(x)] if isinstance(x, Tensor) else x

    return [value(x) for x in numbers]


def resolve(rows: Sequence[dict[str, Number]]) -> Sequence[dict[str, float]]:
    """Make every number of the rows a float, in place; before a row that has been read all have been."""
    unread = list(takewhile(_is_unread, reversed(rows)))
    values = iter(read([x for row in unread for x in row.values()]))
    for row in unread:
        for name in row:
            row[name] = next(values)
    return cast(Sequence[dict[str, float]], rows)


def ratio(part: float, whole: float) -> float:
    """A recipe: part / whole, NaN of nothing."""
    return part / whole if whole else math.nan


def added(*numbers: float) -> float:
    """A recipe: the sum."""
    return sum(numbers)


# Statistics of chosen rows. On the CPU the rows are gathered; elsewhere that would mean to ask how many there are.


def total(values: Float[Tensor, " N"], chosen: Bool[Tensor, " N"]) -> Scalar:
    """The sum over the chosen rows."""
    return scalar(values[chosen].sum() if is_immediate(values) else values.masked_fill(~chosen, 0).sum())


def mean(values: Float[Tensor, " N"], chosen: Bool[Tensor, " N"]) -> Scalar:
    """The mean over the chosen rows; NaN where there are none."""
    return float(values[chosen].mean()) if is_immediate(values) else total(values, chosen) / chosen.sum()


def median(values: Float[Tensor, " N"], chosen: Bool[Tensor, " N"]) -> Scalar:
    """The lower median of the chosen rows; NaN where there are none."""
    if is_immediate(values):
        return float(values[chosen].median()) if bool(chosen.any()) else math.nan
    ranked = values.masked_fill(~chosen, torch.inf).sort().values
    count = chosen.sum()
    middle = ranked.gather(0, ((count - 1).clamp_min(0) // 2)[None])[0]
    return torch.where(count > 0, middle, torch.nan)


def _tensors(x: Number) -> Iterator[Tensor]:
    if isinstance(x, Deferred):
        for part in x.parts:
            yield from _tensors(part)
    elif isinstance(x, Tensor):
        yield x


def _transferred(tensors: Sequence[Tensor]) -> dict[int, float]:
    """Each tensor's number by its id. Those of one type are stacked first: few kernels serve many numbers."""
    by_type: defaultdict[torch.dtype, list[Tensor]] = defaultdict(list)
    for x in {id(x): x for x in tensors}.values():
        by_type[x.dtype].append(x)
    if not by_type:
        return {}
    values = torch.cat([torch.stack(alike).double() for alike in by_type.values()]).tolist()
    return dict(zip((id(x) for alike in by_type.values() for x in alike), values, strict=True))


def _is_unread(row: Mapping[str, Number]) -> bool:
    return any(isinstance(x, Tensor | Deferred) for x in row.values())
