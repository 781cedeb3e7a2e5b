"""The paper's tables, to stand beside our runs, and what a reader has to know before comparing the two.

Numbers as printed in CLEAR: PSNR in dB, SSIM, LPIPS, each a mean over all scenes of the data set; the ablation also gives
the share of Gaussians in conflict. A run finds its line by its name (`+method=`, `+strategy=`), whatever its other
settings are. Published methods that no run matches are listed below the table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from clear_strategies.report.rows import Row
from clear_strategies.report.runs import Run
from clear_strategies.report.table import Columns

# Header of the column, and how its numbers are written; in the order of the numbers below.
_MEASURES: Final = {
    "psnr": ("PSNR", ".2f"), "ssim": ("SSIM", ".3f"), "lpips": ("LPIPS", ".3f"), "conflict": ("conflict", ".3f"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class PaperTable:
    """One table of the paper.

    Args:
        source: where it is printed.
        scenes: how many scenes the numbers average.
        views: training views per scene.
        pixels: HR sizes, width x height, that the protocol may mean.
        numbers: the paper's name of a method -> PSNR, SSIM, LPIPS and, in the ablation, conflict.
        ours: our name of a method -> the paper's.
    """

    source: str
    scenes: int
    views: int
    pixels: tuple[str, ...]
    numbers: Mapping[str, tuple[float, ...]]
    ours: Mapping[str, str]
    iterations: int = 10_000

    def columns(self, rows: Sequence[Row]) -> dict[str, Columns]:
        """The paper's numbers, each right of ours; LPIPS, which we do not measure, right of SSIM."""
        found = [self._numbers(row) for row in rows]
        cells = {
            measure: {f"{name}, paper": [format(of[measure], form) if measure in of else "" for of in found]}
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
        matched = {self.ours.get(row.name) for row in rows}
        if missing := [name for name in self.numbers if name not in matched]:
            forms = [form for _, form in _MEASURES.values()]
            listed = [f"{name} {' / '.join(map(format, self.numbers[name], forms))}" for name in missing]
            head = "PSNR / SSIM / LPIPS" + " / conflict" * any(len(n) > 3 for n in self.numbers.values())
            lines.append(f"Published, and not run here ({head}): {'; '.join(listed)}.")
        return lines

    def _numbers(self, row: Row) -> dict[str, float]:
        return dict(zip(_MEASURES, self.numbers.get(self.ours.get(row.name, ""), ()), strict=False))

    def _differences(self, runs: Sequence[Run]) -> list[str]:
        """Where our runs departed from the protocol, as far as the paper states it."""

        def planned(label: str) -> list[str]:
            return list(dict.fromkeys(run.plan[label] for run in runs if label in run.plan))

        found = []
        if iterations := sorted({run.iterations for run in runs} - {self.iterations}):
            found.append(f"{', '.join(f'{n:,}' for n in iterations)} iterations")
        if counts := sorted({text.split(":")[0] for text in planned("train views")} - {str(self.views)}):
            found.append(f"{', '.join(counts)} training views")
        inputs = [re.split(", (?:SR images|reference): ", text, maxsplit=1) for text in planned("HR")]
        if sizes := dict.fromkeys(size for size, *_ in inputs if size.partition(" ")[0] not in self.pixels):
            found.append(f"HR {', '.join(sizes)} (protocol: {' or '.join(self.pixels)})")
        if priors := dict.fromkeys(prior for _, *rest in inputs for prior in rest if "resshift" not in prior.lower()):
            found.append(f"prior {', '.join(priors)} (paper: ResShift)")
        if clouds := planned("initial points"):
            found.append(f"initial points {' | '.join(clouds)} (the paper does not say where its own come from)")
        return found


_OURS: Final = {
    "3dgs_lr": "3DGS",
    "srgs": "SRGS",
    "mip_splatting_lr": "Mip-Splatting",
    "dropgaussian": "DropGaussian",
    "splatsure": "SplatSuRe",
    "dropgaussian_srgs": "DropGaussian + SRGS",
    "dropgaussian_splatsure": "DropGaussian + SplatSuRe",
    "clear": "CLEAR",
    "clear_paper": "CLEAR",
    "gco + p2g + svs": "CLEAR",
}

PAPER: Final = {
    "llff": PaperTable(
        "Table 1, LLFF ×4, 3 views",
        scenes=8,
        views=3,
        pixels=("2016x1512", "1008x756"),
        numbers={
            "NeRF-SR": (9.28, 0.226, 0.617),
            "RegNeRF": (15.78, 0.432, 0.448),
            "3DGS": (12.51, 0.325, 0.573),
            "SRGS": (17.46, 0.499, 0.387),
            "Mip-Splatting": (15.05, 0.456, 0.517),
            "DropGaussian": (18.57, 0.551, 0.390),
            "SplatSuRe": (18.72, 0.573, 0.377),
            "DropGaussian + SRGS": (19.14, 0.555, 0.326),
            "DropGaussian + SplatSuRe": (19.33, 0.578, 0.333),
            "S2Gaussian": (20.17, 0.640, 0.314),
            "CLEAR": (20.42, 0.682, 0.266),
        },
        ours=_OURS,
    ),
    "blender": PaperTable(
        "Table 2, Blender ×4, 8 views",
        scenes=8,
        views=8,
        pixels=("800x800",),
        numbers={
            "NeRF-SR": (12.41, 0.744, 0.515),
            "RegNeRF": (20.68, 0.841, 0.129),
            "3DGS": (20.49, 0.829, 0.155),
            "SRGS": (22.47, 0.852, 0.126),
            "Mip-Splatting": (22.66, 0.859, 0.121),
            "DropGaussian": (22.92, 0.866, 0.128),
            "SplatSuRe": (23.01, 0.867, 0.119),
            "DropGaussian + SRGS": (22.99, 0.866, 0.119),
            "DropGaussian + SplatSuRe": (23.09, 0.872, 0.117),
            "S2Gaussian": (23.78, 0.876, 0.104),
            "CLEAR": (24.26, 0.880, 0.087),
        },
        ours=_OURS,
    ),
    "mip360": PaperTable(
        "Table 3, Mip-NeRF 360 ×4, 24 views",
        scenes=7,
        views=24,
        pixels=(
            "2472x1644", "2592x1680", "2488x1648", "1556x1036", "1556x1040", "1560x1040",
        ),
        numbers={
            "NeRF-SR": (10.26, 0.269, 0.628),
            "RegNeRF": (17.28, 0.417, 0.449),
            "3DGS": (16.69, 0.357, 0.488),
            "SRGS": (18.52, 0.466, 0.389),
            "Mip-Splatting": (18.38, 0.470, 0.409),
            "DropGaussian": (18.74, 0.489, 0.400),
            "SplatSuRe": (19.02, 0.501, 0.389),
            "DropGaussian + SRGS": (20.79, 0.597, 0.304),
            "DropGaussian + SplatSuRe": (21.12, 0.624, 0.302),
            "S2Gaussian": (21.96, 0.669, 0.298),
            "CLEAR": (22.19, 0.697, 0.288),
        },
        ours=_OURS,
    ),
    "ablation": PaperTable(
        "Table 4, cumulative ablation, LLFF ×4, 3 views",
        scenes=8,
        views=3,
        pixels=("2016x1512", "1008x756"),
        numbers={
            "baseline": (18.74, 0.569, 0.375, 0.243),
            "+ GCO": (19.72, 0.604, 0.303, 0.228),
            "+ P2G": (20.09, 0.629, 0.287, 0.210),
            "+ SVS": (20.42, 0.682, 0.266, 0.162),
        },
        ours={
            "baseline": "baseline",
            "gco": "+ GCO",
            "gco + p2g": "+ P2G",
            "gco + p2g + svs": "+ SVS",
            "clear": "+ SVS",
            "clear_paper": "+ SVS",
        },
    ),
}  # fmt: skip
