"""The result of a stress measurement, and the table of all of them."""

from __future__ import annotations

import csv
import math
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import msgspec

from clear_strategies import files


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement.

    Args:
        what: what was checked. backend: where it ran.
        cases: how many inputs. worst: the largest error, or the number of failures, over all of them.
        bound: what `worst` may be at most.
        where: the input of the worst error.
        goal: how many inputs a release is measured with; 0: as many as there are.
        part: the measurement that the row belongs to, for `python -m tests.stress --only`.
        measured: the day.
    """

    what: str
    backend: str
    cases: int
    worst: float
    bound: float
    where: str
    goal: int = 0
    part: str = ""
    measured: str = ""

    @property
    def met(self) -> bool:
        return self.cases > 0 and math.isfinite(self.worst) and self.worst <= self.bound

    def require(self) -> None:
        assert self.met, f"{self.what}, {self.backend}: {self.worst:.3g}, allowed {self.bound:g}, at {self.where}"


def table(rows: Iterable[Row]) -> str:
    """Markdown."""
    lines = [
        "| check | backend | cases | goal | worst | bound | met | worst case | measured |",
        "|---|---|---:|---:|---:|---:|---|---|---|",
    ]
    for r in rows:
        met = "**no**" if not r.met else "yes" if r.cases >= r.goal else "so far"
        goal = f"{r.goal:,}" if r.goal else "all"
        lines.append(
            f"| {r.what} | {r.backend} | {r.cases:,} | {goal} | {r.worst:.2g} | {r.bound:g} | {met} | {r.where} "
            f"| {r.measured} |"
        )
    return "\n".join(lines) + "\n"


def read(path: Path) -> list[Row]:
    """The rows of earlier measurements; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return msgspec.convert(list(csv.DictReader(file)), list[Row], strict=False)


def write(path: Path, rows: Iterable[Row]) -> None:
    names = [field.name for field in fields(Row)]
    files.write_csv(path, ({name: getattr(row, name) for name in names} for row in rows), names)


def merged(
    earlier: Sequence[Row], measured: Sequence[Row], order: Sequence[str], whole: Container[str] = ()
) -> list[Row]:
    """The earlier rows with the measured ones in their places, by part.

    Args:
        whole: the parts that were measured to the end: an earlier row of theirs that was not measured again goes.
    """
    now = {(row.part, row.what, row.backend) for row in measured}
    kept = [
        row for row in earlier
        if row.part in order and row.part not in whole and (row.part, row.what, row.backend) not in now
    ]  # fmt: skip
    return sorted([*kept, *measured], key=lambda row: order.index(row.part))


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

    def row(self, what: str, backend: str, bound: float, goal: int = 0) -> Row:
        return Row(what, backend, self.cases, self.error, bound, self.where, goal)
