"""One figure for all questions: what is bought against what it costs."""

from __future__ import annotations

import textwrap

import pandas as pd
from matplotlib.figure import Figure

from clear_strategies.outputs.figures import new_figure

WHO = ["scene", "name", "line", "mark"]
"""The first columns of what is drawn; the two behind them are x and y, and their names are those of the axes."""


def lines(rows: pd.DataFrame, *, log: bool = False) -> Figure:
    """One panel per scene, one colour per name, one line per name and line; a mark stands beside its point."""
    x, y = rows.columns[len(WHO) :]
    scenes, names = rows["scene"].unique(), list(rows["name"].unique())
    figure, (panels,) = new_figure(1, len(scenes), 1.2 + 3 * len(scenes), 4.2)
    for axis in panels[1:] if log else ():
        axis.sharey(panels[0])
    for axis, scene in zip(panels, scenes, strict=True):
        for (name, _), points in rows[rows["scene"] == scene].groupby(["name", "line"], sort=False):
            color = f"C{names.index(name)}"
            axis.plot(points[x], points[y], "o-", markersize=3, color=color)
            for mark, *point in points[["mark", x, y]].itertuples(index=False):
                axis.annotate(mark, point, (5, 3), textcoords="offset points", fontsize=8, color="gray")
        axis.set(title=scene, xlabel=x, yscale="log" if log else "linear")
        axis.margins(x=0.25, y=0.15)
        axis.grid(alpha=0.25)
    panels[0].set_ylabel(y)
    for i, name in enumerate(names):
        panels[0].plot([], [], "o-", markersize=3, color=f"C{i}", label=textwrap.fill(name, 48 * len(scenes)))
    columns = max(1, 40 * len(scenes) // max(map(len, names)))  # that the width holds
    figure.legend(loc="outside lower left", fontsize=8, ncols=min(columns, len(names)))
    return figure
