"""The paper's tables, to stand beside our runs, and what a reader has to know before comparing the two.

published.csv has the numbers as printed in CLEAR: PSNR in dB, SSIM, LPIPS, each a mean over all scenes of the data set; the
ablation also gives the share of Gaussians in conflict. Its column `ours` names the runs (`+method=`, `+strategy=`) that stand
beside a line, whatever their other settings are. Published methods that no run matches are listed below the table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import pandas as pd

from clear_strategies.report.runs import Run

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
    def lines(self) -> pd.DataFrame:
        """The table's lines of published.csv, by the paper's name of the method."""
        return _published().query("table == @self.key").set_index("method")

    def numbers(self, names: pd.Series[str]) -> pd.DataFrame:
        """A line for each name of a method, for report.csv; nan where the paper has no number."""
        return self._by_name().reindex(names)[list(_MEASURES)].add_prefix("paper_").set_index(names.index)

    def columns(self) -> dict[str, dict[str, dict[str, str]]]:
        """Quantity -> header -> name of a method -> the paper's number, to stand right of ours."""
        cells: dict[str, dict[str, dict[str, str]]] = {}
        for measure, (header, form) in _MEASURES.items():
            numbers = self._by_name()[measure].dropna()
            # We do not measure LPIPS: the paper's stands right of SSIM.
            beside = cells.setdefault("ssim" if measure == "lpips" else measure, {})
            beside[f"{header}, paper"] = {name: format(number, form) for name, number in numbers.items()}
        return cells

    def _by_name(self) -> pd.DataFrame:
        """The lines that our runs stand beside, by the name of the method."""
        lines = self.lines.assign(ours=self.lines["ours"].str.split(";")).explode("ours").dropna(subset="ours")
        return lines.set_index("ours")

    def notes(self, runs: Sequence[Run]) -> list[str]:
        """What the numbers are means of, how our runs differ from the protocol, and what else was published."""
        scenes = len({run.scene for run in runs})
        ours = f"each of our {scenes} scenes" if scenes > 1 else "our one scene"
        lines = [
            f"In the paper: CLEAR, {self.source}; the mean of {self.scenes} scenes after {self.iterations:,} iterations, "
            f"here beside {ours}. LPIPS is not measured here."
        ]
        if differences := self._differences(runs):
            lines.append(f"Ours differs: {'; '.join(differences)}.")
        run_here = self.lines["ours"].str.split(";").map(lambda names: any(run.name in names for run in runs), "ignore")
        if len(missing := self.lines[run_here != True]):  # noqa: E712 - nan where none of ours stands beside it
            forms = [form for _, form in _MEASURES.values()]
            listed = [
                f"{name} {' / '.join(format(x, f) for x, f in zip(row, forms, strict=True) if not math.isnan(x))}"
                for name, *row in missing[list(_MEASURES)].itertuples(name=None)
            ]
            head = "PSNR / SSIM / LPIPS" + " / conflict" * (self.key == "ablation")
            lines.append(f"Published, and not run here ({head}): {'; '.join(listed)}.")
        return lines

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
def _published() -> pd.DataFrame:
    return pd.read_csv(Path(__file__).parent / "published.csv")


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
