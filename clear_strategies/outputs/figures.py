"""Figures by matplotlib, without a display: curves over the iterations, and sheets of images.

Images on a sheet are scaled by whole factors; of an image that is reduced, a part is shown pixel for pixel, because a resized
image does not show the detail that this library is about.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import torch

from clear_strategies.data.photo_files import PNG_LEVEL
from clear_strategies.files import write_bytes

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

DPI: Final = 100
_JPEG_QUALITY: Final = 80  # of 100, with colours at every pixel: within 3 levels of 255 on average

INK, FAINT, RULE = "#222222", "#888888", "#cccccc"
# Paul Tol's bright scheme, which colour-blind readers can tell apart too.
BLUE, RED, GREEN, YELLOW, CYAN, PURPLE = "#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377"

AS_WRITTEN: Final[dict[str, Any]] = {"parse_math": False}
"""Style of a text that contains the user's names: matplotlib would typeset text between two $ as mathematics."""

Item = TypeVar("Item")

# Title, column of history.csv, column of the x axis, True for a running mean.
_CHARTS: Final = (
    ("LR loss (running mean)", "loss_lr", "t", True),
    ("PSNR of test views at HR, dB", "psnr_test", "t", False),
    ("PSNR of test views at HR, dB", "psnr_test", "seconds", False),
    ("share of Gaussians in conflict, before correction (running mean)", "conflict", "t", True),
    ("share of Gaussians that are corrected (running mean)", "corrected", "t", True),
    ("number of Gaussians", "n_gaussians", "t", False),
)
_AXIS: Final = {"t": "iteration", "seconds": "training time, s"}
_COLOURS: Final = (BLUE, RED, GREEN, YELLOW, CYAN, PURPLE)
_STYLES: Final = [{"color": color, "linestyle": dash} for dash, color in product(("-", "--", ":"), _COLOURS)]

ERROR_MAX: Final = 0.25  # the colours of an error map end here
_ERRORS: Final[dict[str, Any]] = {"cmap": "magma", "vmin": 0, "vmax": ERROR_MAX}  # without effect on RGB
_GAP: Final = 8  # px
_LINE: Final = 16  # height of a line of small print, px
_NARROW, _WIDE, _TALL = 240, 512, 384  # the least and the greatest width and the greatest height of a shown image, px
_ENLARGED: Final = 4  # magnification of the part over that of its image, if the image is not reduced
_SCREEN: Final = 1600  # px, size of a sheet from which its letters are enlarged, because screens show it reduced


def spaced(items: Sequence[Item], count: int) -> Sequence[Item]:
    """Every n-th item, at most `count` in all."""
    return items[:: math.ceil(len(items) / count) or 1] if count else ()


def new_figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    """A figure of `width` x `height` inches and its axes [rows, columns], without pyplot's global state."""
    from matplotlib.figure import Figure as NewFigure

    figure = NewFigure(figsize=(width, height), dpi=DPI, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def set_title(figure: Figure, title: str) -> None:
    figure.suptitle(title, fontsize=12, color=INK, x=0.01, ha="left", **AS_WRITTEN)


def save(figure: Figure, path: Path) -> None:
    """Write the figure in the format of the suffix: .png for lines and letters, .jpg for photos, a quarter as large."""
    buffer, kind = io.BytesIO(), path.suffix[1:]
    options = {"png": {"compress_level": PNG_LEVEL}, "jpg": {"quality": _JPEG_QUALITY, "subsampling": 0}}[kind]
    figure.savefig(buffer, format=kind, dpi=DPI, pil_kwargs=options)
    write_bytes(path, buffer.getvalue())


def write_curves(path: Path, histories: Mapping[str, pd.DataFrame], title: str) -> None:
    """Draw six charts with one line per run, and one legend below them."""
    figure, axes = new_figure(2, 3, 15, 8)
    known = {}
    for axis, (name, column, over, smooth) in zip(axes.flatten(), _CHARTS, strict=True):
        axis.set_title(name)
        axis.set_xlabel(_AXIS[over], fontsize=8, color=FAINT)
        for i, (run, history) in enumerate(histories.items()):
            points = history.reindex(columns=[over, column]).dropna()
            y = points[column]
            if smooth:  # over a 50th of the rows
                y = y.rolling(max(1, len(y) // 50)).mean()
            for reset in (
                history.reindex(columns=["t", "opacities_reset"]).dropna()["t"] if over == "t" and len(y) else ()
            ):
                known["opacities are reset"] = axis.axvline(reset, color=FAINT, linewidth=1, linestyle=":", zorder=0)
            if len(y):
                marker = "o" if column == "psnr_test" else None
                style = {"linewidth": 1.4, "marker": marker, "markersize": 3.5, **_STYLES[i % len(_STYLES)]}
                (known[run],) = axis.plot(points[over], y, **style)
        if column == "loss_lr" and math.isfinite(axis.dataLim.minposy):  # a value is positive
            axis.set_yscale("log")  # after a reset of the opacities the loss is a hundred times as large
        _finish(axis, column)
    if known:
        names = [textwrap.fill(run, width=60) for run in known]
        legend = figure.legend(
            known.values(), names, fontsize=9, frameon=False, loc="outside lower center", labelcolor=INK,
            ncols=min(3, len(known)),
        )  # fmt: skip
        for text in legend.get_texts():
            text.set(**AS_WRITTEN)
    set_title(figure, title)
    save(figure, path)


def _finish(axis: Any, column: str) -> None:
    """Style the axes; those without data say which column of history.csv is empty."""
    axis.title.set(fontsize=10, color=INK)
    axis.tick_params(which="both", labelsize=8, colors=FAINT)
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set_color(RULE)
    if axis.lines:
        axis.set_xlim(left=0)
        axis.grid(alpha=0.25, linewidth=0.5)
    else:
        text = f"not measured: nothing has logged {column}"
        axis.text(0.5, 0.5, text, fontsize=9, color=FAINT, ha="center", transform=axis.transAxes)
        axis.set(xticks=[], yticks=[])


@dataclass(frozen=True, slots=True, eq=False)
class SheetRow:
    """Images by their column, RGB [H, W, 3] or an error [H, W], and the line below each.

    Args:
        name: of the row.
        compared: the columns by which a part of the images is chosen, see `window`; it is outlined, and shown below. Empty: no
            part is shown.
        truth: the column that these are compared with, if it is known.
    """

    name: str
    images: Mapping[str, np.ndarray]
    captions: Mapping[str, str] = field(default_factory=dict)
    compared: Collection[str] = ()
    truth: str | None = None

    def part(self, times: float) -> tuple[slice, slice] | None:
        """The part that is outlined and shown below, see `window`."""
        if not self.compared:
            return None
        return window([self.images[name] for name in self.compared], self.images.get(self.truth or ""), times)


def magnification(height: int, width: int) -> float:
    """The factor at which an image is shown: a whole number, so that pixels stay squares, or less than 1 for a large image."""
    if height > _TALL or width > _WIDE:
        return min(_WIDE / width, _TALL / height)
    return max(1, min(math.ceil(_NARROW / width), _TALL // height))


def window(
    images: Sequence[np.ndarray], truth: np.ndarray | None = None, times: float | None = None
) -> tuple[slice, slice]:
    """Find the part [rows, columns] of RGB images [H, W, 3] where they differ most; the central one if all are equal. With the
    truth, it is where the sum of errors varies most between images, which noise in all of them does not affect.

    For images that a sheet reduces, the part has the size at which they are shown, and is at most square.

    Args:
        times: the magnification of the sheet, whose other images may be larger; None: of these images.
    """
    several = np.stack(images)
    apart = several.std(axis=0).mean(axis=-1)
    errors = None if truth is None else np.abs(several - truth).mean(axis=-1)
    times = magnification(*apart.shape) if times is None else times
    h, w = (max(1, round(size * times) if times < 1 else size // _ENLARGED) for size in apart.shape)
    h = min(h, w) if times < 1 else h
    tops, lefts = (range(0, size - part + 1, max(1, part // 4)) for size, part in zip(apart.shape, (h, w), strict=True))
    windows = [(slice(top, top + h), slice(left, left + w)) for top in tops for left in lefts]

    def difference(part: tuple[slice, slice]) -> float:
        return float(apart[part].sum() if errors is None else errors[:, *part].sum(axis=(1, 2)).std())

    return max(windows, key=difference) if apart.any() else windows[len(windows) // 2]


class _Sheet:
    """A figure of `width` x `height` px with elements at px from its upper left corner. It has no axes, which take matplotlib
    longer than all the rest.

    Args:
        larger: the factor of the size of letters.
    """

    def __init__(self, width: int, height: int, larger: float = 1.0) -> None:
        from matplotlib.figure import Figure

        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
        self._width, self._height, self._larger = width, height, larger

    def text(self, x: float, y: float, words: str, size: float = 8.5, **style: Any) -> None:
        style = {"ha": "center", "va": "center", "color": INK, **AS_WRITTEN, **style}
        self.figure.text(x / self._width, 1 - y / self._height, words, fontsize=size * self._larger, **style)

    def image(self, pixels: np.ndarray, x: int, y: int, **colors: Any) -> Any:
        return self.figure.figimage(pixels, x, self._height - y - len(pixels), **colors)

    def outline(self, part: tuple[slice, slice], times: float, x: int, y: int) -> None:
        """Outline a part of the image that is shown at (x, y), `times` as large."""
        from matplotlib.patches import Rectangle

        top, bottom, left, right = (times * edge for along in part for edge in (along.start, along.stop))
        u, v, w, h = self._box(x + left, y + top, right - left, bottom - top)
        self.figure.add_artist(Rectangle((u, v), w, h, fill=False, color="white", linewidth=1))

    def color_bar(self, error: Any, x: int, y: int, height: int) -> None:
        """Draw the colours of an error map beside the images."""
        beside = self.figure.add_axes(self._box(x, y, 12, height))
        bar = self.figure.colorbar(error, cax=beside, extend="max", extendfrac=0.03)
        bar.set_label("mean |difference| over RGB", fontsize=8 * self._larger, color=INK)
        bar.ax.tick_params(labelsize=8 * self._larger, colors=INK)
        bar.outline.set_visible(False)

    def _box(self, x: float, y: float, w: float, h: float) -> tuple[float, float, float, float]:
        """A rectangle of w x h px in matplotlib's units: fractions of the figure, from its lower left corner."""
        return x / self._width, 1 - (y + h) / self._height, w / self._width, h / self._height


def write_contact_sheet(path: Path, rows: Sequence[SheetRow], title: str, note: str = "") -> None:
    """Draw the rows below the names of their columns, a colour bar beside them if there are errors, and `note` below them."""
    columns = list(dict.fromkeys(column for row in rows for column in row.images))
    h, w = (max(image.shape[axis] for row in rows for image in row.images.values()) for axis in (0, 1))
    times = magnification(h, w)
    cell_h, cell_w = round(times * h), round(times * w)
    parts = [row.part(times) for row in rows]
    zoom = 1 if times < 1 else int(times) * _ENLARGED  # of the parts
    below = [0 if part is None else zoom * (part[0].stop - part[0].start) + _GAP for part in parts]  # their heights
    larger = max(1.0, max(len(columns) * cell_w, len(rows) * cell_h + sum(below)) / _SCREEN)
    line = round(_LINE * larger)
    heads = [textwrap.wrap(column, round(cell_w / 7 / larger) or 1) or [""] for column in columns]
    lefts = [2 * line + i * (cell_w + _GAP) for i in range(len(columns) + 1)]  # the last is the end of the images
    top, pitch = (4 + max(map(len, heads))) * line, cell_h + 2 * line + _GAP
    tops = [top + j * pitch + sum(below[:j]) for j in range(len(rows) + 1)]
    with_bar, error = any(image.ndim == 2 for row in rows for image in row.images.values()), None
    height = tops[-1] + line
    sheet = _Sheet(lefts[-1] + 5 * line * with_bar, height, larger)
    sheet.text(_GAP, 1.5 * line, title, 12, ha="left")
    for x, column, head in zip(lefts, columns, heads, strict=False):
        sheet.text(x + cell_w / 2, top - line / 2, "\n".join(head), 10, va="bottom")
        for y, row, part, part_h in zip(tops, rows, parts, below, strict=False):
            if (pixels := row.images.get(column)) is not None:
                drawn = sheet.image(_resized(pixels, times), x, y, **_ERRORS)
                error = drawn if pixels.ndim == 2 else error
                if part is not None:
                    sheet.image(_resized(pixels[part], zoom), x, y + cell_h + _GAP, **_ERRORS)
                    sheet.outline(part, times, x, y)
            sheet.text(x + cell_w / 2, y + cell_h + part_h + line, row.captions.get(column, ""))
    for y, row in zip(tops, rows, strict=False):
        sheet.text(line, y + cell_h / 2, row.name, rotation=90, color=FAINT)
    sheet.text(lefts[0], height - line, note, ha="left", color=FAINT)
    if error is not None:
        sheet.color_bar(error, lefts[-1], top, cell_h)
    save(sheet.figure, path)


def write_tiles(path: Path, tiles: Mapping[str, np.ndarray], title: str, columns: int) -> None:
    """Draw images side by side in rows of `columns`, each below its name and at the size of the largest on a sheet.

    Args:
        tiles: RGB [H, W, 3], or numbers in [0, 1], [H, W], which are colour-mapped: dark is 0, bright is 1, grey is nan.
    """
    from matplotlib import colormaps

    h, w = (max(image.shape[axis] for image in tiles.values()) for axis in (0, 1))
    cell_h, cell_w = (round(magnification(h, w) * size) for size in (h, w))
    heads = ["\n".join(textwrap.fill(line, cell_w // 6 or 1) for line in name.splitlines()) for name in tiles]
    head = (2 + max(name.count("\n") for name in heads)) * _LINE
    width = _GAP + min(columns, len(tiles)) * (cell_w + _GAP)
    height = 2 * _LINE + -(-len(tiles) // columns) * (head + cell_h) + _GAP
    sheet, numbers = _Sheet(width, height), colormaps["viridis"].with_extremes(bad=RULE)
    sheet.text(_GAP, 1.2 * _LINE, title, 12, ha="left")
    for i, (name, image) in enumerate(zip(heads, tiles.values(), strict=True)):
        x, y = _GAP + i % columns * (cell_w + _GAP), 2 * _LINE + i // columns * (head + cell_h) + head
        shown = _resized(image, min(cell_h / image.shape[0], cell_w / image.shape[1]))
        sheet.image(shown, x, y, cmap=numbers, vmin=0, vmax=1)
        sheet.text(x + cell_w / 2, y - _LINE / 3, name, va="bottom")
    save(sheet.figure, path)


def _resized(pixels: np.ndarray, times: float) -> np.ndarray:
    """Enlarge by repeating pixels, or reduce by means over areas."""
    if times >= 1:
        return pixels.repeat(int(times), 0).repeat(int(times), 1)
    size = [round(times * edge) for edge in pixels.shape[:2]]
    channels = torch.from_numpy(pixels.reshape(1, *pixels.shape[:2], -1)).permute(0, 3, 1, 2)
    reduced = torch.nn.functional.interpolate(channels, size, mode="area")[0].permute(1, 2, 0)
    return np.asarray(reduced.reshape(*size, *pixels.shape[2:]).numpy())
