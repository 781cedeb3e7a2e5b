"""Time against error: one panel a scene, one line a backend through its cut-offs."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from clear_strategies.bench.rasterizers import BACKWARD, FORWARD, Row
from clear_strategies.errors import DataError
from clear_strategies.files import write_bytes

_COLORS: Final = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")  # Paul Tol's bright scheme
_MARKERS: Final = "osD^vP"
_INK, _FAINT = "#222222", "#888888"


def time_against_error(path: Path, rows: Sequence[Row]) -> None:
    """Down and to the left is better.

    Raises:
        DataError: no row has an error.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [row for row in rows if row.none is not None]
    panels = list(dict.fromkeys(row.scene for row in rows))
    backends = list(dict.fromkeys(row.backend for row in rows))
    if not panels:
        raise DataError(path, "picture", "no error was measured", "ask for a scene that float64 can draw in time")
    figure = Figure(figsize=(1.2 + 4.2 * len(panels), 4.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axis, scene in zip(axes, panels, strict=True):
        for i, backend in enumerate(backends):
            color, marker = _COLORS[i % len(_COLORS)], _MARKERS[i % len(_MARKERS)]
            points = [
                (m[FORWARD] + m[BACKWARD[0]], row.none.relative["means"], row.preset)
                for row in rows
                if row.scene == scene and row.backend == backend and row.none is not None and (m := row.median)
            ]
            if not points:
                continue
            ms, errors, _ = zip(*points, strict=True)
            axis.plot(ms, errors, color=color, marker=marker, linewidth=1.6, markersize=5)
            # Neighbours of nearly the same speed are labelled on opposite sides and at opposite ends.
            even = i % 2 == 0
            for x, y, preset in points:
                axis.annotate(
                    preset, (x, y), (6 if even else -6, 4), textcoords="offset points", fontsize=8, color=_FAINT,
                    ha="left" if even else "right",
                )  # fmt: skip
            axis.annotate(
                backend, points[0][:2] if even else points[-1][:2], (0, 14 if even else -18),
                textcoords="offset points", fontsize=10, color=color, ha="center", fontweight="bold",
            )  # fmt: skip
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.margins(x=0.25, y=0.15)
        axis.set_title(scene, fontsize=10, color=_INK)
        axis.set_xlabel("forward + backward, ms", fontsize=9, color=_INK)
        axis.tick_params(which="both", labelsize=8, colors=_FAINT)
        axis.spines[["top", "right"]].set_visible(False)
        axis.spines[["left", "bottom"]].set_color("#cccccc")
        axis.grid(alpha=0.25, linewidth=0.5)
    axes[0].set_ylabel("error of the positions' gradient, relative L2", fontsize=9, color=_INK)
    figure.suptitle("Time against error (float64 without cut-offs)", fontsize=12, color=_INK, x=0.01, ha="left")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_bytes(path, buffer.getvalue())
