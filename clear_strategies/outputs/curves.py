"""Curves over the iterations: curves.png of one run, curves_SCENE.png of a report."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from clear_strategies.outputs import figures
from clear_strategies.outputs.figures import History, save_png

_COLOURS: Final = (figures.BLUE, figures.RED, figures.GREEN, figures.YELLOW, figures.CYAN, figures.PURPLE)
_DASHES: Final = ("-", "--", ":")
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


def write_curves(path: Path, histories: Mapping[str, History], title: str) -> None:
    """Draw six charts with one line per run, and one legend below them."""
    figure, axes = figures.new_figure(2, 3, 15, 8)
    known = {}
    for axis, (name, column, over, smooth) in zip(axes.flatten(), _CHARTS, strict=True):
        axis.set_title(name)
        axis.set_xlabel(_AXIS[over], fontsize=8, color=figures.FAINT)
        for i, (run, history) in enumerate(histories.items()):
            x, y = figures.curve(history, column, over=over, smooth=smooth)
            if len(x):
                (known[run],) = axis.plot(
                    x, y, color=_COLOURS[i % len(_COLOURS)], linewidth=1.4,
                    linestyle=_DASHES[i // len(_COLOURS) % len(_DASHES)],
                    marker="o" if column == "psnr_test" else None, markersize=3.5,
                )  # fmt: skip
        if axis.lines:
            axis.set_xlim(left=0)
        figures.finish(axis)
    if known:
        names = [textwrap.fill(run, width=60) for run in known]
        legend = figure.legend(
            known.values(), names, fontsize=9, frameon=False, loc="outside lower center", labelcolor=figures.INK,
            ncols=min(3, len(known)),
        )  # fmt: skip
        for text in legend.get_texts():
            text.set(**figures.AS_WRITTEN)
    figures.set_title(figure, title)
    save_png(figure, path)
