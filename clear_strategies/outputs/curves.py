"""Curves over the iterations: curves.png of one run, curves_SCENE.png of a report."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from clear_strategies.outputs import figures

if TYPE_CHECKING:
    import pandas as pd

# Title, column of history.csv, what it is drawn over, whether as a running mean.
_CHARTS: Final = (
    ("LR loss (running mean)", "loss_lr", "t", True),
    ("PSNR of test views, dB", "psnr_test", "t", False),
    ("PSNR of test views, dB", "psnr_test", "seconds", False),
    ("share of Gaussians in conflict, before correction (running mean)", "conflict", "t", True),
    ("share of the Gaussians that is corrected (running mean)", "corrected", "t", True),
    ("number of Gaussians", "n_gaussians", "t", False),
)
_AXIS: Final = {"t": "iteration", "seconds": "training time, s"}
_COLOURS: Final = (figures.BLUE, figures.RED, figures.GREEN, figures.YELLOW, figures.CYAN, figures.PURPLE)
_STYLES: Final = [{"color": color, "linestyle": dash} for dash, color in product(("-", "--", ":"), _COLOURS)]


def write_curves(path: Path, histories: Mapping[str, pd.DataFrame], title: str) -> None:
    """Draw six charts with one line per run, and one legend below them."""
    figure, axes = figures.new_figure(2, 3, 15, 8)
    known = {}
    for axis, (name, column, over, smooth) in zip(axes.flatten(), _CHARTS, strict=True):
        axis.set_title(name)
        axis.set_xlabel(_AXIS[over], fontsize=8, color=figures.FAINT)
        for i, (run, history) in enumerate(histories.items()):
            points = history.reindex(columns=[over, column]).dropna()
            y = points[column]
            if smooth:  # over a 50th of the rows
                y = y.rolling(max(1, len(y) // 50)).mean()
            if len(y):
                marker = "o" if column == "psnr_test" else None
                style = {"linewidth": 1.4, "marker": marker, "markersize": 3.5, **_STYLES[i % len(_STYLES)]}
                (known[run],) = axis.plot(points[over], y, **style)
        _finish(axis)
    if known:
        names = [textwrap.fill(run, width=60) for run in known]
        legend = figure.legend(
            known.values(), names, fontsize=9, frameon=False, loc="outside lower center", labelcolor=figures.INK,
            ncols=min(3, len(known)),
        )  # fmt: skip
        for text in legend.get_texts():
            text.set(**figures.AS_WRITTEN)
    figures.set_title(figure, title)
    figures.save_png(figure, path)


def _finish(axis: Any) -> None:
    """Style the axes so that the data stands out; axes without data say "not measured"."""
    axis.title.set(fontsize=10, color=figures.INK)
    axis.tick_params(which="both", labelsize=8, colors=figures.FAINT)
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set_color(figures.RULE)
    if axis.lines:
        axis.set_xlim(left=0)
        axis.grid(alpha=0.25, linewidth=0.5)
    else:
        axis.text(0.5, 0.5, "not measured", fontsize=9, color=figures.FAINT, ha="center", transform=axis.transAxes)
        axis.set(xticks=[], yticks=[])
