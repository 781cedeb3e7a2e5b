"""Curves as small SVGs that take the page's colours, light or dark; drawn here because a plotting library's are larger
than the pictures they stand beside.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from clear_strategies.outputs.pictures import RUN_COLORS

_WIDTH, _HEIGHT = 460, 250  # px, before the page scales them
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 24, 30, 40  # the right one holds half a label
_POINTS: Final = 240  # of a curve; more are not seen
_DASHES: Final = ("", "6 3", "2 3")

History = Sequence[Mapping[str, float]]


def chart(
    title: str, axis: str, histories: Mapping[str, History], *, x: str, y: str, smooth: bool = False, dots: bool = False
) -> str:
    """One column of the histories over another, a line a method; says so where nothing was measured.

    Args:
        title: with the unit. axis: what x is, with the unit.
        smooth: a running mean over a 50th of the rows.
    """
    curves = {name: _points(history, x, y, smooth=smooth) for name, history in histories.items()}
    known = [points for points in curves.values() if len(points)]
    head = f'<text class="title" x="{_LEFT}" y="16">{html.escape(title)}</text>'
    if not known:
        body = f'<text x="{_WIDTH / 2}" y="{_HEIGHT / 2}" text-anchor="middle">not measured</text>'
        return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{html.escape(title)}">{head}{body}</svg>'
    every = np.concatenate(known)
    x_ticks, y_ticks = _ticks(0.0, float(every[:, 0].max())), _ticks(*_range(every[:, 1]))
    (x0, x1), (y0, y1) = (0.0, float(every[:, 0].max()) or 1.0), (y_ticks[0], y_ticks[-1])

    def place(points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        across = _LEFT + (points[:, 0] - x0) / (x1 - x0) * (_WIDTH - _LEFT - _RIGHT)
        down = _HEIGHT - _BOTTOM - (points[:, 1] - y0) / (y1 - y0) * (_HEIGHT - _TOP - _BOTTOM)
        return np.stack((across, down), axis=1)

    parts = [head]
    for value in y_ticks:
        level = place(np.array([[0.0, value]]))[0, 1]
        parts.append(f'<path class="grid" d="M{_LEFT} {level:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{level + 3.5:.1f}" text-anchor="end">{_number(value, y_ticks)}</text>')
    for value in x_ticks:
        at = place(np.array([[value, y0]]))[0, 0]
        label = _number(value, x_ticks)
        parts.append(f'<text x="{at:.1f}" y="{_HEIGHT - _BOTTOM + 15}" text-anchor="middle">{label}</text>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle">{html.escape(axis)}</text>')
    for number, (name, points) in enumerate(curves.items()):
        if len(points):
            parts.extend(_line(name, number, place(points), dots=dots))
    label = html.escape(title)
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def legend(names: Sequence[str]) -> str:
    """The line of each name, once for all charts of a scene."""
    items = "".join(
        f'<li><svg class="key" viewBox="0 0 28 8" aria-hidden="true"><path {_stroke(i)} d="M0 4H28"/></svg>'
        f"{html.escape(name)}</li>"
        for i, name in enumerate(names)
    )
    return f'<ul class="legend">{items}</ul>'


def _line(name: str, number: int, points: Float[np.ndarray, "P 2"], *, dots: bool) -> Iterator[str]:
    path = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    yield f'<path class="curve" {_stroke(number)} d="M{path}"><title>{html.escape(name)}</title></path>'
    if dots:
        color = RUN_COLORS[number % len(RUN_COLORS)]
        yield from (f'<circle fill="{color}" cx="{x:.1f}" cy="{y:.1f}" r="2.2"/>' for x, y in points)


def _stroke(number: int) -> str:
    dash = _DASHES[number // len(RUN_COLORS) % len(_DASHES)]
    return f'stroke="{RUN_COLORS[number % len(RUN_COLORS)]}"' + (f' stroke-dasharray="{dash}"' if dash else "")


def _points(history: History, x: str, y: str, *, smooth: bool) -> Float[np.ndarray, "P 2"]:
    rows = [(row[x], row[y]) for row in history if x in row and math.isfinite(row.get(y, math.nan))]
    points = np.array(rows, dtype=float).reshape(-1, 2)
    window = max(1, len(points) // 50)
    if smooth and window > 1:
        kernel = np.ones(window) / window
        points = np.stack((points[window - 1 :, 0], np.convolve(points[:, 1], kernel, mode="valid")), axis=1)
    return points[:: max(1, math.ceil(len(points) / _POINTS))]


def _range(values: Float[np.ndarray, " P"]) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _ticks(low: float, high: float) -> list[float]:
    """Three to seven round numbers, the first at or below `low`, the last at or above `high`."""
    rough = max((high - low) / 4, 1e-12)
    power = 10 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [float(k * step) for k in range(first, max(last, first + 1) + 1)]


def _number(value: float, ticks: Sequence[float]) -> str:
    digits = max(0, -math.floor(math.log10(ticks[1] - ticks[0]) + 1e-9))
    return f"{value:,.{digits}f}"
