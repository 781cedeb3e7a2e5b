"""What the benchmark leaves: tables that read alike in a terminal and as Markdown, JSON with every repeat, and the part
of docs/benchmarks.md that is generated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from clear_strategies import files
from clear_strategies.bench.machine import machine, sentence
from clear_strategies.errors import DataError
from clear_strategies.report import aligned

UNKNOWN: Final = "–"


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A table under a heading: column -> cells. `notes`: what its reader must know."""

    title: str
    columns: Mapping[str, Sequence[str]]
    notes: Sequence[str] = ()


@dataclass(slots=True, eq=False)
class Findings:
    """Everything one question found.

    Args:
        question: "rasterizers", "kernels", "iteration", "pareto" or "device"; names the markers in the documentation.
        skipped: one line each: what was not measured, and why.
        raw: for the JSON file: settings, and rows with every repeat. failed: something that should work did not.
    """

    question: str
    threads: int
    sections: list[Section] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    raw: dict[str, Any] = field(default_factory=dict)
    failed: bool = False


def markdown(findings: Findings) -> str:
    """Tables, notes, what was skipped, and the machine."""
    blocks = []
    for section in findings.sections:
        columns = {name: cells for name, cells in section.columns.items() if any(cell != UNKNOWN for cell in cells)}
        blocks.append("\n".join((f"### {section.title}", "", *aligned(columns))))
        blocks += section.notes
    if findings.skipped:
        blocks.append("\n".join(("Not measured:", "", *(f"- {line}" for line in findings.skipped))))
    blocks.append(sentence(machine(findings.threads)))
    return "\n\n".join(blocks) + "\n"


def leave(
    findings: Findings, *, json: Path | None = None, markdown_file: Path | None = None, docs: Path | None = None
) -> str:
    """Write the files that were asked for; returns the Markdown.

    Raises:
        DataError: `docs` lacks the markers.
    """
    text = markdown(findings)
    if json is not None:
        facts = {"question": findings.question, "machine": machine(findings.threads), "skipped": findings.skipped}
        files.write_json(json, {**facts, **findings.raw})
    if markdown_file is not None:
        files.write_text(markdown_file, text)
    if docs is not None:
        page = docs.read_text(encoding="utf-8")
        files.write_text(docs, between_markers(page, findings.question, text, source=docs))
    return text


def between_markers(page: str, name: str, text: str, *, source: Path) -> str:
    """`page` with what stands between `<!-- bench:name -->` and `<!-- /bench:name -->` replaced.

    Raises:
        DataError: a marker is missing, doubled, or they are in the wrong order.
    """
    first, last = f"<!-- bench:{name} -->", f"<!-- /bench:{name} -->"
    if page.count(first) != 1 or page.count(last) != 1 or page.index(first) > page.index(last):
        problem = "must be there once each, in this order"
        raise DataError(source, f"{first} and {last}", problem, "add the two lines where the tables belong")
    head, tail = page[: page.index(first) + len(first)], page[page.index(last) :]
    return f"{head}\n\n{text.strip()}\n\n{tail}"


def number(value: float | None, digits: int = 3) -> str:
    """Three significant digits, never more than the unit needs: 0.123, 1.23, 12.3, 123, 1,234."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{min(decimals, digits)}f}"


def small(value: float | None) -> str:
    """Errors: 2.1e-3."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return "0" if value == 0 else f"{mantissa}e{int(exponent)}"


def times(value: float | None) -> str:
    """Ratios: 1.23x."""
    return UNKNOWN if value is None or not math.isfinite(value) else f"{number(value)}x"
