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
from functools import partial
from itertools import accumulate, islice, takewhile
from operator import itemgetter
from typing import Final, NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Deferred(NamedTuple):
    """A function of scalars that have not been read yet. The function may log."""

    recipe: Callable[..., float]
    parts: tuple[Number, ...]


class Element(NamedTuple):
    """The k-th number of a vector on a device that is never written to again. Many elements cost less than a tensor each, and are
    fetched together.
    """

    vector: Float[Tensor, " K"] | Int[Tensor, " K"]
    k: int


class Derived(NamedTuple):
    """A function of the numbers of a vector on a device that is never written to again."""

    vector: Float[Tensor, " K"]
    of: Callable[[Sequence[float]], float]


_UNREAD: Final = (Tensor, Deferred, Element, Derived)

Scalar = float | Tensor
"""For arithmetic: a float, or a 0-dim tensor on a device that is never written to again."""

Number = Scalar | Deferred | Element | Derived
"""For logs and tables: a scalar, or a function of scalars."""


def is_immediate(x: Tensor) -> bool:
    """Return True if scalars computed from x are read at once: x is in the CPU's memory."""
    return x.device.type == "cpu"


def scalar(x: Tensor) -> Scalar:
    """A 0-dim tensor as a float if it is on the CPU, else itself."""
    return float(x.detach().numpy()) if is_immediate(x) else x


def elements(x: Int[Tensor, " K"] | Float[Tensor, " K"]) -> Sequence[Number]:
    """The numbers of a vector; read at once on the CPU."""
    return x.tolist() if is_immediate(x) else [Element(x, k) for k in range(x.shape[0])]


def defer(recipe: Callable[..., float], *numbers: Number) -> Number:
    """recipe(*numbers), at once if all numbers are floats."""
    for x in numbers:
        if isinstance(x, _UNREAD):
            return Deferred(recipe, numbers)
    return recipe(*numbers)


def read(numbers: Sequence[Number]) -> list[float]:
    """The numbers as floats; those on the device are fetched in one transfer."""
    values = _transferred([x for number in numbers for x in _tensors(number)])

    def value(x: Number) -> float:
        if isinstance(x, Deferred):
            return x.recipe(*map(value, x.parts))
        if isinstance(x, Element):
            return values[id(x.vector)][x.k]
        if isinstance(x, Derived):
            return x.of(values[id(x.vector)])
        return values[id(x)][0] if isinstance(x, Tensor) else x

    return [value(x) for x in numbers]


def gathered(row: Mapping[str, Number]) -> tuple[Float[Tensor, " K"], Callable[[Tensor], dict[str, Number]]]:
    """The numbers on the device that a row is made of, as one float64 vector, and the row of a copy of that vector."""
    found = {id(x): x for number in row.values() for x in _tensors(number)}
    firsts = dict(zip(found, accumulate((x.numel() for x in found.values()), initial=0), strict=False))
    parts = [x.reshape(-1) for x in found.values()]
    device = parts[0].device if parts else None
    vector = torch.cat([*parts, torch.empty(0, dtype=torch.float64, device=device)])

    def position(number: Number) -> int | None:
        vector = number if isinstance(number, Tensor) else getattr(number, "vector", None)
        return None if vector is None else firsts[id(vector)] + getattr(number, "k", 0)

    def reader(number: Number) -> Callable[[Sequence[float]], float]:
        if isinstance(number, Deferred):
            recipe, each = number.recipe, [*map(reader, number.parts)]
            return lambda values: recipe(*(one(values) for one in each))
        if (k := position(number)) is None:
            return lambda _: cast(float, number)
        return (lambda values: number.of(values[k:])) if isinstance(number, Derived) else itemgetter(k)

    def maker(number: Number) -> Callable[[Tensor], Number]:
        if isinstance(number, (Deferred, Derived)):  # one tuple, of however many numbers
            return partial(Derived, of=reader(number))
        return (lambda _: number) if (k := position(number)) is None else partial(Element, k=k)

    makers = {name: maker(number) for name, number in row.items()}
    return vector, lambda copy: {name: make(copy) for name, make in makers.items()}


def resolve(rows: Sequence[dict[str, Number]]) -> Sequence[dict[str, float]]:
    """Turn every number of the rows into a float, in place. Rows before a resolved one are resolved already."""
    unread = list(takewhile(lambda row: any(isinstance(x, _UNREAD) for x in row.values()), reversed(rows)))
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
    elif isinstance(x, (Element, Derived)):
        yield x.vector
    elif isinstance(x, Tensor):
        yield x


def _transferred(tensors: Sequence[Tensor]) -> dict[int, Sequence[float]]:
    """Each tensor's numbers by its id. Tensors of one type are joined first, so that few kernels fetch many numbers."""
    by_type: defaultdict[torch.dtype, list[Tensor]] = defaultdict(list)
    for x in {id(x): x for x in tensors}.values():
        by_type[x.dtype].append(x)
    if not by_type:
        return {}
    joined = torch.cat([torch.cat([x.view(-1) for x in alike]).double() for alike in by_type.values()])
    values = iter(joined.tolist())
    return {id(x): [*islice(values, x.numel())] for alike in by_type.values() for x in alike}
