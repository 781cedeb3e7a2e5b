"""A table of images: contact_sheet.png of a run, comparison_SCENE.png of a report.

Images are laid out in whole pixels: a render is shown pixel for pixel, a small one at a whole multiple, because a resized
image does not show the detail that this library is about.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from clear_strategies.outputs.figures import AS_WRITTEN, DPI, FAINT, INK, save_png

ERROR_MAX: Final = 0.25  # the colours of an error map end here
_GAP: Final = 8  # px
_LINE: Final = 16  # height of a line of small print, px
_NARROW, _WIDE = 240, 640  # the least and the greatest width at which an image is shown, px


@dataclass(frozen=True, slots=True, eq=False)
class SheetRow:
    """Images by their column, RGB [H, W, 3] or an error [H, W], and the line below each.

    Args:
        name: of the row. frame: the window [rows, columns] that is outlined in each image.
    """

    name: str
    images: Mapping[str, np.ndarray]
    captions: Mapping[str, str] = field(default_factory=dict)
    frame: tuple[slice, slice] | None = None


def magnification(width: int) -> float:
    """How many times larger an image of this width is shown: a whole number, so that pixels stay squares, or less than 1
    for an image that is too wide.
    """
    return math.ceil(_NARROW / width) if width <= _WIDE else _WIDE / width


def write_contact_sheet(path: Path, rows: Sequence[SheetRow], title: str, note: str = "") -> None:
    """Draw the rows below the names of their columns, and a bar of colours beside them where there are errors. `note` stands
    below.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    columns = list(dict.fromkeys(column for row in rows for column in row.images))
    shapes = [image.shape for row in rows for image in row.images.values()]
    times = magnification(max(shape[1] for shape in shapes))
    cell_h, cell_w = (round(times * max(shape[axis] for shape in shapes)) for axis in (0, 1))
    heads = [textwrap.wrap(column, cell_w // 7) or [""] for column in columns]
    left, top, row_h = 2 * _LINE, (4 + max(map(len, heads))) * _LINE, cell_h + 2 * _LINE + _GAP
    right, with_bar = left + len(columns) * (cell_w + _GAP), any(len(shape) == 2 for shape in shapes)
    width, height = right + 5 * _LINE * with_bar, top + len(rows) * row_h + _LINE
    figure, error = Figure(figsize=(width / DPI, height / DPI), dpi=DPI), None

    def text(x: float, y: float, words: str, **style: Any) -> None:
        style = {"fontsize": 8.5, "ha": "center", "va": "center", "color": INK, **AS_WRITTEN, **style}
        figure.text(x / width, 1 - y / height, words, **style)

    def box(x: float, y: float, w: float, h: float) -> tuple[float, float, float, float]:
        return x / width, 1 - (y + h) / height, w / width, h / height

    text(_GAP, 1.5 * _LINE, title, fontsize=12, ha="left")
    for i, lines in enumerate(heads):
        x = left + i * (cell_w + _GAP)
        text(x + cell_w / 2, top - _LINE / 2, "\n".join(lines), fontsize=10, va="bottom")
        for j, row in enumerate(rows):
            y, pixels = top + j * row_h, row.images.get(columns[i])
            if pixels is not None:
                shown = _resized(pixels, times)
                drawn = figure.figimage(shown, x, height - y - len(shown), cmap="magma", vmin=0, vmax=ERROR_MAX)
                error = drawn if pixels.ndim == 2 else error
                if row.frame is not None:
                    down, across = (slice(times * s.start, times * s.stop) for s in row.frame)
                    place = box(x + across.start, y + down.start, across.stop - across.start, down.stop - down.start)
                    figure.add_artist(Rectangle(place[:2], *place[2:], fill=False, color="white", linewidth=1))
            text(x + cell_w / 2, y + cell_h + _LINE, row.captions.get(columns[i], ""))
    for j, row in enumerate(rows):
        text(_LINE, top + j * row_h + cell_h / 2, row.name, rotation=90, color=FAINT)
    text(left, height - _LINE, note, ha="left", color=FAINT)
    if error is not None:
        bar = figure.colorbar(error, cax=figure.add_axes(box(right, top, 12, cell_h)), extend="max", extendfrac=0.03)
        bar.set_label("mean |difference| over RGB", fontsize=8, color=INK)
        bar.ax.tick_params(labelsize=8, colors=INK)
        bar.outline.set_visible(False)
    save_png(figure, path)


def _resized(pixels: np.ndarray, times: float) -> np.ndarray:
    """Each pixel repeated where the image is shown larger, means where it is shown smaller."""
    if times >= 1:
        return pixels.repeat(int(times), 0).repeat(int(times), 1)
    size = [round(times * edge) for edge in pixels.shape[:2]]
    channels = torch.from_numpy(pixels.reshape(1, *pixels.shape[:2], -1)).permute(0, 3, 1, 2)
    reduced = torch.nn.functional.interpolate(channels, size, mode="area")[0].permute(1, 2, 0)
    return np.asarray(reduced.reshape(*size, *pixels.shape[2:]).numpy())
