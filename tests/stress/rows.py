"""What a stress measurement found, and the page of all of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement.

    Args:
        what: what was checked. backend: where it ran.
        cases: how many inputs. worst: the largest error, or the number of failures, over all of them.
        bound: what `worst` may be at most.
        where: the input of the worst error.
    """

    what: str
    backend: str
    cases: int
    worst: float
    bound: float
    where: str

    @property
    def met(self) -> bool:
        return self.cases > 0 and math.isfinite(self.worst) and self.worst <= self.bound

    def require(self) -> None:
        assert self.met, f"{self.what}, {self.backend}: {self.worst:.3g}, allowed {self.bound:g}, at {self.where}"


def table(rows: Iterable[Row]) -> str:
    """Markdown."""
    lines = ["| check | backend | cases | worst | bound | met | worst case |", "|---|---|---:|---:|---:|---|---|"]
    lines += [
        f"| {r.what} | {r.backend} | {r.cases:,} | {r.worst:.2g} | {r.bound:g} | {'yes' if r.met else '**no**'} | {r.where} |"
        for r in rows
    ]
    return "\n".join(lines) + "\n"


@dataclass(slots=True)
class Worst:
    """The largest error so far, and its input."""

    cases: int = 0
    error: float = 0.0
    where: str = "none"

    def add(self, error: float, where: str) -> None:
        self.cases += 1
        if not error <= self.error:  # NaN counts as the largest
            self.error, self.where = (math.inf if math.isnan(error) else error), where

    def row(self, what: str, backend: str, bound: float) -> Row:
        return Row(what, backend, self.cases, self.error, bound, self.where)
