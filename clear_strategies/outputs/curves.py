"""curves.png: losses, quality, number of Gaussians and conflict over the iterations of one run."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from clear_strategies.outputs import figures
from clear_strategies.outputs.figures import History

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GROUP_COLOURS: Final = {
    "means": figures.BLUE,
    "sh0": figures.RED,
    "shN": figures.GREEN,
    "opacities": figures.YELLOW,
    "scales": figures.CYAN,
    "quats": figures.PURPLE,
}


def write_curves(path: Path, history: History, marks: Mapping[str, int], title: str) -> None:
    """Draw what happened over iterations. A column that is missing or NaN is not drawn; marks, by name, are numbered lines."""
    figure, axes = figures.new_figure(2, 3, 15, 8)
    losses, quality, structure, conflict, correction, detail = axes.flatten()

    losses.set_title("losses (running mean)")
    for column, name, colour in (
        ("loss_lr", "LR", figures.BLUE),
        ("loss_base", "HR base", figures.RED),
        ("loss_hf", "HR high frequency", figures.GREEN),
    ):
        _draw(losses, history, column, name, colour, smooth=True)
    if losses.lines:
        losses.set_yscale("log")
    quality.set_title("PSNR, dB")
    _draw(quality, history, "psnr_train_lr", "training views, LR (running mean)", figures.GREY, smooth=True)
    _draw(quality, history, "psnr_test", "test views, HR", figures.RED, marker="o")
    structure.set_title("number of Gaussians")
    _draw(structure, history, "n_gaussians", "", figures.INK)
    conflict.set_title("share of Gaussians in conflict, before correction")
    for group, colour in _GROUP_COLOURS.items():
        _draw(conflict, history, f"conflict_{group}", group, colour, smooth=True, linewidth=0.9)
    _draw(conflict, history, "conflict", "all together", figures.INK, smooth=True)
    correction.set_title("correction")
    for column, name, colour in (
        ("corrected", "share corrected", figures.INK),
        ("mean_q", "mean reliability q", figures.CYAN),
        ("mean_omega", "mean ω of the corrected", figures.PURPLE),
    ):
        _draw(correction, history, column, name, colour, smooth=True)
    correction.set_ylim(0, 1.35)  # leaves room for the legend above the lines
    correction.set_yticks(np.linspace(0, 1, 6))
    detail.set_title("mean |detail feature|, RGB")
    _draw(detail, history, "detail_abs", "", figures.INK)

    named = []
    last = max((row["t"] for row in history), default=1)
    ordered = sorted(((name, t) for name, t in marks.items() if t <= last), key=lambda mark: mark[1])
    for number, (t, same) in enumerate(groupby(ordered, key=lambda mark: mark[1]), start=1):
        named.append(f"{number}  {', '.join(name for name, _ in same)}, {t:,}")
        for axis in (a for a in axes.flatten() if a.lines):
            axis.axvline(t, color=figures.FAINT, linewidth=0.8, linestyle=":", zorder=0)
            axis.text(
                t, 0.985, f" {number}", fontsize=7, color=figures.FAINT, va="top", transform=axis.get_xaxis_transform()
            )
    for axis in axes.flatten():
        axis.set_xlim(0, last)
        figures.finish(axis, legend="upper right" if axis is correction else "best")
    detail.set_ylim(bottom=0)
    figure.supxlabel("      ".join(("iteration", *named)), fontsize=9, color=figures.INK)
    figures.set_title(figure, title)
    figures.save_png(figure, path)


def _draw(
    axis: Axes, history: History, column: str, label: str, colour: str, *, smooth: bool = False, **style: Any
) -> None:
    t, values = figures.curve(history, column, smooth=smooth)
    if len(t):
        axis.plot(t, values, label=label, color=colour, markersize=3.5, **{"linewidth": 1.4, **style})
