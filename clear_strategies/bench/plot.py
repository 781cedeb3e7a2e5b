"""Time against error: one panel a scene, one line a backend through its cut-offs. Time against quality: one marker a
variant of training, named beside it, and the front.
"""

from __future__ import annotations

import io
import math
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from clear_strategies.bench import pareto
from clear_strategies.bench.rasterizers import BACKWARD, FORWARD, Row
from clear_strategies.errors import DataError
from clear_strategies.files import write_bytes

_COLORS: Final = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")  # Paul Tol's bright scheme
_MARKERS: Final = "osD^vP"
_INK, _FAINT = "#222222", "#888888"
_LOG_FROM: Final = 4  # times that the slowest takes of the fastest: from there on seconds are drawn on a log scale
_FROM: Final = 0.55  # of the fastest's seconds: where the picture begins
_ASIDE: Final = (9, 24, 40, 60, 85)  # px between a marker and its label: the nearest that is free is taken
_CLEARANCE: Final = 6  # px around a marker where no label stands

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

Box = tuple[float, float, float, float]  # left, bottom, right, top, px


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
        _recede(axis)
    axes[0].set_ylabel("error of the positions' gradient, relative L2", fontsize=9, color=_INK)
    figure.suptitle("Time against error (float64 without cut-offs)", fontsize=12, color=_INK, x=0.01, ha="left")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_bytes(path, buffer.getvalue())


def time_against_quality(path: Path, rows: Sequence[pareto.Row], title: str) -> None:
    """Up and to the left is better. Behind each marker, faint, how its first seed came there.

    Raises:
        DataError: no training has a finite PSNR.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    rows = [row for row in rows if math.isfinite(row.mean("psnr"))]
    if not rows:
        raise DataError(path, "picture", "no training has a finite PSNR", "look at the trainings")
    best = pareto.front(rows)
    figure = Figure(figsize=(9, 5.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    seconds, psnr = ([row.mean(quantity) for row in rows] for quantity in ("seconds", "psnr"))
    axis.plot(
        [row.mean("seconds") for row in best], [row.mean("psnr") for row in best], color=_INK, linewidth=1.2, zorder=2,
        label="front",
    )  # fmt: skip
    for kind, color, marker in zip(pareto.KINDS, _COLORS, _MARKERS, strict=False):
        of_kind = [row for row in rows if row.variant.kind == kind]
        for row in of_kind:
            if curve := row.trainings[0].curve:
                axis.plot(*zip(*curve, strict=True), color=color, alpha=0.22, linewidth=1.1, zorder=1)
            axis.errorbar(
                row.mean("seconds"), row.mean("psnr"), _deviation(row.values("psnr")), _deviation(row.values("seconds")),
                color=color, alpha=0.5, linewidth=1, zorder=2,
            )  # fmt: skip
        if of_kind:
            x, y = ([row.mean(quantity) for row in of_kind] for quantity in ("seconds", "psnr"))
            axis.plot(x, y, color=color, marker=marker, markersize=6, linestyle="", zorder=3, label=kind)
    slowest, fastest = max(seconds), min(seconds)
    if slowest > _LOG_FROM * fastest:
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_minor_formatter(lambda *_: "")
    axis.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    # The markers fill the picture; where the curves began lies below it.
    axis.set_xlim(_FROM * fastest, slowest * (1.12 if slowest <= _LOG_FROM * fastest else 1.35))
    room = 0.18 * max(max(psnr) - min(psnr), 0.1)
    axis.set_ylim(min(psnr) - room, max(psnr) + room)
    axis.set_xlabel("seconds of training", fontsize=9, color=_INK)
    axis.set_ylabel("PSNR of the test views, dB", fontsize=9, color=_INK)
    axis.legend(fontsize=8, loc="lower right", framealpha=0.8, edgecolor="none", labelcolor=_INK)
    _recede(axis)
    figure.suptitle(f"Time against quality, {title}", fontsize=12, color=_INK, x=0.01, ha="left")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # what is placed to the pixel must not move again
    _name_markers(axis, rows, best)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_bytes(path, buffer.getvalue())


def _name_markers(axis: Axes, rows: Sequence[pareto.Row], best: Sequence[pareto.Row]) -> None:
    """Each marker's name where nothing else stands, those on the front in bold and first."""
    figure = axis.figure
    colors = dict(zip(pareto.KINDS, _COLORS, strict=False))
    ordered = sorted(rows, key=lambda row: row not in best)
    points = [tuple(axis.transData.transform((row.mean("seconds"), row.mean("psnr")))) for row in ordered]
    texts = [
        figure.text(
            0, 0, row.variant.name, fontsize=8.5, color=colors[row.variant.kind],
            fontweight="bold" if row in best else "normal",
        )
        for row in ordered
    ]  # fmt: skip
    sizes = [(box.width, box.height) for box in (text.get_window_extent() for text in texts)]
    legend = axis.get_legend()
    taken = [_box(legend)] if legend is not None else []
    places = beside(points, sizes, _box(axis), taken)
    to_figure = figure.transFigure.inverted().transform
    for text, box, (x, y) in zip(texts, places, points, strict=True):
        text.set_position(tuple(to_figure(box[:2])))
        text.set_verticalalignment("bottom")
        nearest = (min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3]))
        if math.dist(nearest, (x, y)) > 1.5 * _ASIDE[0]:
            (x0, y0), (x1, y1) = (axis.transData.inverted().transform(point) for point in ((x, y), nearest))
            axis.plot((x0, x1), (y0, y1), color=text.get_color(), alpha=0.5, linewidth=0.7, zorder=2)


def beside(
    points: Sequence[tuple[float, float]], sizes: Sequence[tuple[float, float]], within: Box, taken: Sequence[Box] = ()
) -> list[Box]:
    """Where labels of these sizes go, px: near their points, on no point, and on no other label as far as there is room.

    Args:
        points: of the markers; the first choose first.
        within: where labels may be. taken: where none may be.
    """
    markers = [(x - _CLEARANCE, y - _CLEARANCE, x + _CLEARANCE, y + _CLEARANCE) for x, y in points]
    placed: list[Box] = []
    for point, size in zip(points, sizes, strict=True):

        def crowded(box: Box) -> float:
            return sum(_shared(box, other) for other in (*markers, *placed, *taken)) + _outside(box, within)

        placed.append(min(_around(point, size), key=crowded))  # of equals, the first: the nearest
    return placed


def _around(point: tuple[float, float], size: tuple[float, float]) -> Iterator[Box]:
    """Boxes of a size about a point, the nearest first: right, left, above, below, and the corners between."""
    (x, y), (w, h) = point, size
    for gap in _ASIDE:
        for across, up in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)):
            reach = gap if 0 in (across, up) else gap / math.sqrt(2)
            left, bottom = x + across * (reach + w / 2) - w / 2, y + up * (reach + h / 2) - h / 2
            yield left, bottom, left + w, bottom + h


def _shared(a: Box, b: Box) -> float:
    """The area that two boxes have in common, px²."""
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def _outside(box: Box, within: Box) -> float:
    """The area of a box beyond another, px²."""
    return (box[2] - box[0]) * (box[3] - box[1]) - _shared(box, within)


def _box(artist: Artist) -> Box:
    left, bottom, right, top = map(float, artist.get_window_extent().extents)
    return left, bottom, right, top


def _deviation(values: Sequence[float]) -> float:
    return statistics.stdev(values) if len(values) > 1 else 0.0


def _recede(axis: Axes) -> None:
    """Everything but the data."""
    axis.tick_params(which="both", labelsize=8, colors=_FAINT)
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set_color("#cccccc")
    axis.grid(alpha=0.25, linewidth=0.5)
