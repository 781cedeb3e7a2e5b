"""Scalars that stay on the device until they are read.

A scalar on the CPU is read at once. Reading a scalar from CUDA would make the host wait for all queued work. It therefore
stays a 0-dim tensor, a function of such scalars stays a `Deferred`, and `read` or `resolve` fetch many of them in one
transfer. The same code serves both cases:

    error = deferred.scalar((image - target).square().mean())   # a float on the CPU, else the tensor itself
    psnr = deferred.defer(decibels, error)                      # decibels(error) on the CPU, else a `Deferred`
    deferred.resolve(history)                                   # every number becomes a float
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate, takewhile
from operator import itemgetter
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Deferred(NamedTuple):
    """A function of numbers that have not been read yet, which may log. A vector among them is given to it as a list."""

    recipe: Callable[..., float]
    parts: tuple[Number, ...]


Scalar = float | Tensor
"""For arithmetic: a float, or a 0-dim tensor on a device that is never written to again."""

Number = Scalar | Deferred
"""For logs and tables: a scalar, or a function of scalars."""


def is_immediate(x: Tensor) -> bool:
    """Return True if scalars computed from x are read at once: x is in the CPU's memory."""
    return x.device.type == "cpu"


def scalar(x: Tensor) -> Scalar:
    """A 0-dim tensor as a float if it is on the CPU, else itself."""
    return float(x.detach().numpy()) if is_immediate(x) else x


def elements(x: Int[Tensor, " K"] | Float[Tensor, " K"]) -> Sequence[Number]:
    """The numbers of a vector; read at once on the CPU."""
    if is_immediate(x):
        return x.tolist()
    parts = (x,)  # many numbers of one vector cost less than a tensor each, and are fetched together
    return [Deferred(itemgetter(k), parts) for k in range(x.shape[0])]


def is_unread(x: Number) -> bool:
    """Return True if the number is on a device, or a function of such numbers."""
    return isinstance(x, (Tensor, Deferred))


def defer(recipe: Callable[..., float], *numbers: Number) -> Number:
    """recipe(*numbers), at once if all numbers are floats."""
    return Deferred(recipe, numbers) if any(map(is_unread, numbers)) else recipe(*numbers)


def read(numbers: Sequence[Number]) -> list[float]:
    """The numbers as floats; those on the device are fetched in one transfer."""
    vector, places = _joined(numbers)
    read_once = vector.tolist()
    values = {key: read_once[place] for key, place in places.items()}

    def value(x: Number) -> Any:
        if isinstance(x, Deferred):
            return x.recipe(*map(value, x.parts))
        return values[id(x)] if isinstance(x, Tensor) else x

    return [value(x) for x in numbers]


def gathered(row: Mapping[str, Number]) -> tuple[Float[Tensor, " N"], Callable[[Tensor], dict[str, Number]]]:
    """The numbers on the device that a row is made of, as one float64 vector, and the row of a copy of that vector."""
    vector, places = _joined([*row.values()])

    def reader(number: Number) -> Callable[[Sequence[float]], Any]:
        if isinstance(number, Deferred):
            recipe, each = number.recipe, [*map(reader, number.parts)]
            return lambda values: recipe(*(one(values) for one in each))
        return itemgetter(places[id(number)]) if isinstance(number, Tensor) else lambda _: number

    readers = {name: reader(x) for name, x in row.items() if is_unread(x)}

    def row_of(copy: Tensor) -> dict[str, Number]:
        parts = (copy,)
        return {name: Deferred(readers[name], parts) if name in readers else x for name, x in row.items()}

    return vector, row_of


def resolve(rows: Sequence[dict[str, Number]]) -> Sequence[dict[str, float]]:
    """Turn every number of the rows into a float, in place. Rows before a resolved one are resolved already."""
    unread = list(takewhile(lambda row: any(map(is_unread, row.values())), reversed(rows)))
    values = iter(read([x for row in unread for x in row.values()]))
    for row in unread:
        for name in row:
            row[name] = next(values)
    return cast(Sequence[dict[str, float]], rows)


def ratio(part: float, whole: float) -> float:
    """Part / whole; NaN where whole is 0."""
    return part / whole if whole else math.nan


def added(*numbers: float) -> float:
    return sum(numbers)


def mean(values: Float[Tensor, " N"], chosen: Bool[Tensor, " N"]) -> Scalar:
    """The mean over the chosen rows; NaN where there are none. Gathering them would wait for their number on a device, and costs
    more than zeros on the CPU.
    """
    return scalar(values.masked_fill(~chosen, 0).sum() / chosen.sum())


def _tensors(x: Number) -> Iterator[Tensor]:
    if isinstance(x, Deferred):
        for part in x.parts:
            yield from _tensors(part)
    elif isinstance(x, Tensor):
        yield x


def _joined(numbers: Sequence[Number]) -> tuple[Float[Tensor, " N"], dict[int, int | slice]]:
    """The tensors that the numbers are made of, as one float64 vector, and where each is, by its id. Those of one type are joined
    first, so that few kernels copy many numbers.
    """
    by_type: defaultdict[torch.dtype, list[Tensor]] = defaultdict(list)
    for x in {id(x): x for number in numbers for x in _tensors(number)}.values():
        by_type[x.dtype].append(x)
    found = [x for alike in by_type.values() for x in alike]
    firsts = accumulate((x.numel() for x in found), initial=0)
    places = {id(x): slice(k, k + len(x)) if x.dim() else k for x, k in zip(found, firsts, strict=False)}
    joined = [torch.cat([x.reshape(-1) for x in alike]).double() for alike in by_type.values()]
    return torch.cat(joined) if joined else torch.empty(0, dtype=torch.float64), places
