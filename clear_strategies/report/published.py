"""The paper's tables, to stand beside our runs, and what a reader has to know before comparing the two.

published.csv has the numbers as printed in CLEAR: PSNR in dB, SSIM, LPIPS, each a mean over all scenes of the data set; the
ablation also gives the share of Gaussians in conflict. Its column `ours` names the runs (`+method=`, `+strategy=`) that stand
beside a line, whatever their other settings are. Published methods that no run matches are listed below the table.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from clear_strategies.report.rows import Row
from clear_strategies.report.runs import Run
from clear_strategies.report.table import Columns

# Column of published.csv -> header, and how its numbers are written.
_MEASURES: Final = {
    "psnr": ("PSNR", ".2f"), "ssim": ("SSIM", ".3f"), "lpips": ("LPIPS", ".3f"), "conflict": ("conflict", ".3f"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class PaperTable:
    """One table of the paper.

    Args:
        key: in published.csv.
        source: where it is printed.
        scenes: how many scenes the numbers average.
        views: training views per scene.
        pixels: HR sizes, width x height, that the protocol may mean.
    """

    key: str
    source: str
    scenes: int
    views: int
    pixels: tuple[str, ...]
    iterations: int = 10_000

    @property
    def lines(self) -> dict[str, dict[str, str]]:
        """The table's lines of published.csv, by the paper's name of the method."""
        return {line["method"]: line for line in _published() if line["table"] == self.key}

    def columns(self, rows: Sequence[Row]) -> dict[str, Columns]:
        """The paper's numbers, each right of ours; LPIPS, which we do not measure, right of SSIM."""
        numbers = [self._numbers(row) for row in rows]
        cells = {
            measure: {f"{name}, paper": [format(n[measure], form) if measure in n else "" for n in numbers]}
            for measure, (name, form) in _MEASURES.items()
        }
        cells["ssim"] |= {"LPIPS": ["–" for _ in rows], **cells.pop("lpips")}
        return cells

    def records(self, rows: Sequence[Row]) -> list[dict[str, float]]:
        """Plain numbers for report.csv."""
        return [{f"paper_{m}": self._numbers(row).get(m, math.nan) for m in _MEASURES} for row in rows]

    def notes(self, rows: Sequence[Row]) -> list[str]:
        """What the numbers are means of, how our runs differ from the protocol, and what else was published."""
        runs = [run for row in rows for run in row.runs]
        scenes = len({run.scene for run in runs})
        ours = f"each of our {scenes} scenes" if scenes > 1 else "our one scene"
        lines = [
            f"In the paper: CLEAR, {self.source}; the mean of {self.scenes} scenes after {self.iterations:,} iterations, "
            f"here beside {ours}. LPIPS is not measured here."
        ]
        if differences := self._differences(runs):
            lines.append(f"Ours differs: {'; '.join(differences)}.")
        matched = {self._method(row) for row in rows}
        if missing := [name for name in self.lines if name not in matched]:
            listed = [f"{name} {' / '.join(self._written(name))}" for name in missing]
            head = "PSNR / SSIM / LPIPS" + " / conflict" * (self.key == "ablation")
            lines.append(f"Published, and not run here ({head}): {'; '.join(listed)}.")
        return lines

    def _method(self, row: Row) -> str | None:
        """The paper's name of the row's method; None where it has none."""
        return next((name for name, line in self.lines.items() if row.name in line["ours"].split(";")), None)

    def _written(self, method: str) -> list[str]:
        return [text for measure in _MEASURES if (text := self.lines[method][measure])]

    def _numbers(self, row: Row) -> dict[str, float]:
        method = self._method(row)
        line = {} if method is None else self.lines[method]
        return {measure: float(line[measure]) for measure in _MEASURES if line.get(measure)}

    def _differences(self, runs: Sequence[Run]) -> list[str]:
        """Where our runs departed from the protocol, as far as the paper states it."""

        def planned(label: str) -> list[str]:
            return list(dict.fromkeys(run.plan[label] for run in runs if label in run.plan))

        differences = []
        if iterations := sorted({run.iterations for run in runs} - {self.iterations}):
            differences.append(f"{', '.join(f'{n:,}' for n in iterations)} iterations")
        if counts := sorted({text.split(":")[0] for text in planned("train views")} - {str(self.views)}):
            differences.append(f"{', '.join(counts)} training views")
        inputs = [re.split(", (?:SR images|reference): ", text, maxsplit=1) for text in planned("HR")]
        if sizes := dict.fromkeys(size for size, *_ in inputs if size.partition(" ")[0] not in self.pixels):
            differences.append(f"HR {', '.join(sizes)} (protocol: {' or '.join(self.pixels)})")
        if priors := dict.fromkeys(prior for _, *rest in inputs for prior in rest if "resshift" not in prior.lower()):
            differences.append(f"prior {', '.join(priors)} (paper: ResShift)")
        if clouds := planned("initial points"):
            differences.append(f"initial points {' | '.join(clouds)} (the paper does not say where its own come from)")
        return differences


@cache
def _published() -> list[dict[str, str]]:
    with (Path(__file__).parent / "published.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


_LLFF_PIXELS: Final = ("2016x1512", "1008x756")
_MIP360_PIXELS: Final = ("2472x1644", "2592x1680", "2488x1648", "1556x1036", "1556x1040", "1560x1040")

PAPER: Final = {
    table.key: table
    for table in (
        PaperTable("llff", "Table 1, LLFF ×4, 3 views", 8, 3, _LLFF_PIXELS),
        PaperTable("blender", "Table 2, Blender ×4, 8 views", 8, 8, ("800x800",)),
        PaperTable("mip360", "Table 3, Mip-NeRF 360 ×4, 24 views", 7, 24, _MIP360_PIXELS),
        PaperTable("ablation", "Table 4, cumulative ablation, LLFF ×4, 3 views", 8, 3, _LLFF_PIXELS),
    )
}
