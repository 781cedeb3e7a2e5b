"""What all figures share: colours, matplotlib figures that need no display, and pages laid out in whole pixels."""

from __future__ import annotations

import io
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import torch
from jaxtyping import Float

from clear_strategies.data.photo_files import PNG_LEVEL
from clear_strategies.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import FigureImage

History = Sequence[Mapping[str, float]]
"""One row per iteration, as in history.csv. A cell may be missing or NaN."""

ERROR_MAX: Final = 0.25  # the colours of an error map end here
GAP: Final = 8  # px
LINE: Final = 16  # height of a line of small print, px
_DPI: Final = 100
_NARROW, _WIDE = 240, 640  # the least and the greatest width at which an image is shown, px

INK, FAINT, RULE = "#222222", "#888888", "#cccccc"
# Paul Tol's bright scheme, which colour-blind readers can tell apart too.
BLUE, RED, GREEN, YELLOW, CYAN, PURPLE, GREY = (
    "#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#aaaaaa",
)  # fmt: skip


Item = TypeVar("Item")


def spaced(items: Sequence[Item], count: int) -> Sequence[Item]:
    """Every n-th item, at most `count` in all: the views that a figure shows of many."""
    return items[:: math.ceil(len(items) / count) or 1] if count else ()


# ── charts ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def new_figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    """A figure of `width` x `height` inches and its axes [rows, columns], without pyplot's global state."""
    from matplotlib.figure import Figure as NewFigure

    figure = NewFigure(figsize=(width, height), dpi=_DPI, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def curve(
    history: History, column: str, *, over: str = "t", smooth: bool = False
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """The rows where `column` is finite, as x and y; `smooth` is a running mean over a 50th of them."""
    points = [(row[over], row[column]) for row in history if over in row and math.isfinite(row.get(column, math.nan))]
    x, y = np.array(points, dtype=float).reshape(-1, 2).T
    if smooth and len(y):
        window = max(1, len(y) // 50)
        x, y = x[window - 1 :], np.convolve(y, np.ones(window) / window, mode="valid")
    return x, y


def column_means(history: History) -> dict[str, float]:
    """The mean of each column over the rows where it is not NaN; a column without such a row is left out."""
    columns: defaultdict[str, list[float]] = defaultdict(list)
    for row in history:
        for name, value in row.items():
            columns[name] += [] if math.isnan(value) else [value]
    return {name: sum(values) / len(values) for name, values in columns.items() if values}


def finish(axis: Axes) -> None:
    """Style the axes so that the data stands out; axes without data say "not measured"."""
    axis.title.set_fontsize(10)
    axis.title.set_color(INK)
    axis.tick_params(which="both", labelsize=8, colors=FAINT)
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set_color(RULE)
    if not axis.lines:
        axis.text(0.5, 0.5, "not measured", fontsize=9, color=FAINT, ha="center", transform=axis.transAxes)
        axis.set_xticks([])
        axis.set_yticks([])
        return
    axis.grid(alpha=0.25, linewidth=0.5)


AS_WRITTEN: Final[dict[str, Any]] = {"parse_math": False}
"""Style of a text with names of the user's: matplotlib would read what lies between two $ as mathematics."""


def set_title(figure: Figure, title: str) -> None:
    figure.suptitle(title, fontsize=12, color=INK, x=0.01, ha="left", **AS_WRITTEN)


def save_png(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, pil_kwargs={"compress_level": PNG_LEVEL})
    write_bytes(path, buffer.getvalue())


# ── images in whole pixels ───────────────────────────────────────────────────────────────────────────────────────────


def error_map(image: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Mean absolute difference over RGB, in [0, 1]."""
    return np.asarray(np.abs(image - truth).mean(axis=-1))


def magnification(width: int) -> float:
    """How many times larger an image of this width is shown: a whole number, so that pixels stay squares, or less than 1
    for an image that is too wide.
    """
    return math.ceil(_NARROW / width) if width <= _WIDE else _WIDE / width


class PixelPage:
    """A figure whose coordinates are pixels from the top left."""

    def __init__(self, width: int, height: int, title: str) -> None:
        from matplotlib.figure import Figure as NewFigure

        self.width, self.height = width, height
        self.figure = NewFigure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        self.text(GAP, 1.5 * LINE, title, size=12)

    def image(self, x: int, y: int, pixels: np.ndarray, times: float) -> FigureImage:
        """Draw RGB, or an error map in colours, `times` larger, with the top left corner at (x, y)."""
        height, width = (round(size * times) for size in pixels.shape[:2])
        resized, below = _resized(pixels, height, width), self.height - y - height
        return self.figure.figimage(resized, x, below, cmap="magma", vmin=0, vmax=ERROR_MAX)

    def frame(self, x: float, y: float, width: float, height: float, color: str) -> None:
        """Draw the outline of a rectangle whose top left corner is at (x, y)."""
        from matplotlib.patches import Rectangle

        corner, size = (x / self.width, 1 - (y + height) / self.height), (width / self.width, height / self.height)
        self.figure.add_artist(Rectangle(corner, *size, fill=False, color=color, linewidth=1))

    def colour_bar(self, x: int, y: int, height: int, drawn: FigureImage, label: str) -> None:
        """The colours of an error map, 12 px wide, with its numbers to the right; larger ones have the last colour."""
        place = (x / self.width, 1 - (y + height) / self.height, 12 / self.width, height / self.height)
        bar = self.figure.colorbar(drawn, cax=self.figure.add_axes(place), extend="max", extendfrac=0.03)
        bar.set_label(label, fontsize=8, color=INK)
        bar.ax.tick_params(labelsize=8, colors=INK)
        bar.outline.set_visible(False)

    def text(self, x: float, y: float, words: str, *, size: float = 8.5, **style: Any) -> None:
        """Write words at (x, y), centred vertically unless `va` says otherwise."""
        place = {"ha": "left", "va": "center", "color": INK, **AS_WRITTEN, **style}
        self.figure.text(x / self.width, 1 - y / self.height, words, fontsize=size, **place)


def _resized(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Each pixel repeated where the image is shown larger, means where it is shown smaller."""
    if width < pixels.shape[1]:
        channels = torch.from_numpy(pixels.reshape(1, *pixels.shape[:2], -1)).permute(0, 3, 1, 2)
        reduced = torch.nn.functional.interpolate(channels, (height, width), mode="area")
        return np.asarray(reduced[0].permute(1, 2, 0).reshape(height, width, *pixels.shape[2:]).numpy())
    row, column = (np.arange(size) * full // size for size, full in zip((height, width), pixels.shape, strict=False))
    return np.asarray(pixels[row[:, None], column])
