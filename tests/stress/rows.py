"""The result of a stress measurement, and the table of all of them."""

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

    def __str__(self) -> str:
        """A row of the Markdown table."""
        worst = f"{self.worst:.2g}" if self.met else f"**{self.worst:.2g}**"
        return f"| {self.what} | {self.backend} | {self.cases:,} | {worst} | {self.bound:g} | {self.where} |"


HEADER = "| check | backend | cases | worst | bound | worst case |\n|---|---|---:|---:|---:|---|"


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

    def add_to_last(self, error: float, where: str) -> None:
        """Another finding about the case that was added last."""
        self.cases -= 1
        self.add(error, where)

    def row(self, what: str, backend: str, bound: float) -> Row:
        return Row(what, backend, self.cases, self.error, bound, self.where)


def failures(outcomes: Iterable[tuple[str, str | None]], what: str, backend: str) -> Row:
    """How many inputs failed: (the input, what is wrong with its outcome; None: nothing)."""
    wrong, cases, first = 0, 0, "none"
    for where, problem in outcomes:
        cases += 1
        if problem is not None:
            wrong, first = wrong + 1, first if wrong else f"{where}: {problem}"
    return Row(what, backend, cases, float(wrong), 0, first)
