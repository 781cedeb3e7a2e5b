"""curves.png: losses, quality, number of Gaussians and conflict over the iterations of one run."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np

from clear_strategies.outputs import figures
from clear_strategies.outputs.figures import BLUE, CYAN, GREEN, GREY, INK, PURPLE, RED, YELLOW, History

_GROUPS: Final = {"means": BLUE, "sh0": RED, "shN": GREEN, "opacities": YELLOW, "scales": CYAN, "quats": PURPLE}
# The title of each chart, and its lines: column of history.csv, label, colour, whether as a running mean, style.
_CHARTS: Final[Mapping[str, list[tuple[str, str, str, bool, dict[str, Any]]]]] = {
    "losses (running mean)": [
        ("loss_lr", "LR", BLUE, True, {}),
        ("loss_base", "HR base", RED, True, {}),
        ("loss_hf", "HR high frequency", GREEN, True, {}),
    ],
    "PSNR, dB": [
        ("psnr_train_lr", "training views, LR (running mean)", GREY, True, {}),
        ("psnr_test", "test views, HR", RED, False, {"marker": "o"}),
    ],
    "number of Gaussians": [("n_gaussians", "", INK, False, {})],
    "share of Gaussians in conflict, before correction": [
        *((f"conflict_{group}", group, colour, True, {"linewidth": 0.9}) for group, colour in _GROUPS.items()),
        ("conflict", "all together", INK, True, {}),
    ],
    "correction": [
        ("corrected", "share corrected", INK, True, {}),
        ("mean_q", "mean reliability q", CYAN, True, {}),
        ("mean_omega", "mean ω of the corrected", PURPLE, True, {}),
    ],
    "mean |detail feature|, RGB": [("detail_abs", "", INK, False, {})],
}


def write_curves(path: Path, history: History, marks: Mapping[str, int], title: str) -> None:
    """Draw what happened over iterations. A column that is missing or NaN is not drawn; marks, by name, are numbered lines."""
    figure, axes = figures.new_figure(2, 3, 15, 8)
    losses, _, _, _, correction, detail = axes.flatten()
    for axis, (name, lines) in zip(axes.flatten(), _CHARTS.items(), strict=True):
        axis.set_title(name)
        for column, label, colour, smooth, style in lines:
            t, values = figures.curve(history, column, smooth=smooth)
            if len(t):
                axis.plot(t, values, label=label, color=colour, markersize=3.5, **{"linewidth": 1.4, **style})
    if losses.lines:
        losses.set_yscale("log")
    correction.set_ylim(0, 1.35)  # leaves room for the legend above the lines
    correction.set_yticks(np.linspace(0, 1, 6))

    numbered = ["iteration"]
    last = max((row["t"] for row in history), default=1)
    ordered = sorted(((name, t) for name, t in marks.items() if t <= last), key=lambda mark: mark[1])
    for number, (t, same) in enumerate(groupby(ordered, key=lambda mark: mark[1]), start=1):
        numbered.append(f"{number}  {', '.join(name for name, _ in same)}, {t:,}")
        for axis in (a for a in axes.flatten() if a.lines):
            axis.axvline(t, color=figures.FAINT, linewidth=0.8, linestyle=":", zorder=0)
            top = axis.get_xaxis_transform()
            axis.text(t, 0.985, f" {number}", fontsize=7, color=figures.FAINT, va="top", transform=top)
    for axis in axes.flatten():
        axis.set_xlim(0, last)
        figures.finish(axis, legend="upper right" if axis is correction else "best")
    detail.set_ylim(bottom=0)
    figure.supxlabel("      ".join(numbered), fontsize=9, color=INK)
    figures.set_title(figure, title)
    figures.save_png(figure, path)
