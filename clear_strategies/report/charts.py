"""Charts of several runs: PSNR, conflict and number of Gaussians, as a PNG and as an SVG for the page."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from clear_strategies.outputs import figures
from clear_strategies.outputs.figures import History

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS: Final = (figures.BLUE, figures.RED, figures.GREEN, figures.YELLOW, figures.CYAN, figures.PURPLE)
_DASHES: Final = ("-", "--", ":")
_POINTS: Final = 240  # per curve, at most
# Title, column of history.csv, what it is drawn over, whether as a running mean.
_CHARTS: Final = (
    ("PSNR of test views, dB", "psnr_test", "t", False),
    ("PSNR of test views, dB", "psnr_test", "seconds", False),
    ("share of Gaussians in conflict, before correction (running mean)", "conflict", "t", True),
    ("number of Gaussians", "n_gaussians", "t", False),
)
_AXIS: Final = {"t": "iteration", "seconds": "training time, s"}


def draw_runs(histories: Mapping[str, History], title: str) -> Figure:
    """Four charts with one line per run, and one legend below them."""
    figure, axes = figures.new_figure(2, 2, 12, 8)
    known = {}
    for axis, (name, column, over, smooth) in zip(axes.flatten(), _CHARTS, strict=True):
        axis.set_title(name)
        axis.set_xlabel(_AXIS[over], fontsize=8, color=figures.FAINT)
        for i, (run, history) in enumerate(histories.items()):
            x, y = figures.curve(history, column, over=over, smooth=smooth)
            if len(x) == 0:
                continue
            step = math.ceil(len(x) / _POINTS)
            (known[run],) = axis.plot(
                x[::step], y[::step], color=_COLOURS[i % len(_COLOURS)], linewidth=1.4,
                linestyle=_DASHES[i // len(_COLOURS) % len(_DASHES)],
                marker="o" if column == "psnr_test" else None, markersize=3.5,
            )  # fmt: skip
        if axis.lines:
            axis.set_xlim(left=0)
        figures.finish(axis, legend=None)
    if known:
        names = [textwrap.fill(run, width=60) for run in known]
        legend = figure.legend(
            known.values(), names, fontsize=9, frameon=False, loc="outside lower center", labelcolor=figures.INK,
            ncols=min(3, len(known)),
        )  # fmt: skip
        for text in legend.get_texts():
            text.set(**figures.AS_WRITTEN)
    figures.set_title(figure, title)
    return figure


def as_svg(figure: Figure) -> str:
    """The figure as an <svg> element for HTML. Text stays text, and takes its font and colours, light or dark, from
    page.css.
    """
    import matplotlib as mpl

    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Format", "Type", "Creator", "Date"))
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": str(figure.get_suptitle())}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=no_metadata)
    svg = buffer.getvalue()
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"|font-family: [^;]*; ', "", svg[svg.index("<svg") :])
    for colour, variable in ((figures.INK, "--ink"), (figures.FAINT, "--faint"), (figures.RULE, "--line")):
        svg = svg.replace(colour, f"var({variable})")
    return svg
