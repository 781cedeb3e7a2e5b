"""Results to look at: the contact sheet of a run, its curves, and runs side by side.

Images are laid out in whole pixels: a render is shown pixel for pixel (small ones at a whole multiple), because what
this library is about, detail, is what a resized picture does not show. Runs and attributes keep their colours.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from clear_strategies.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_DPI: Final = 100
_NARROW, _WIDE = 240, 640  # an image is shown at least, and at most, this wide; px
_GAP: Final = 8  # px
_LINE: Final = 16  # height of a line of small print, px
_ABREAST: Final = 6  # runs beside each other in a comparison
_ERROR_MAX: Final = 0.25  # where the colours of an error map end
_CROP: Final = 4  # a crop is this many times smaller than the image, on each side

_INK, _FAINT = "#222222", "#888888"
_BLUE, _RED, _GREEN, _YELLOW, _CYAN, _PURPLE, _GREY = (
    "#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#aaaaaa",
)  # fmt: skip  # Paul Tol's bright scheme, told apart by the colour-blind too
_GROUP_COLORS: Final = {
    "means": _BLUE, "sh0": _RED, "shN": _GREEN, "opacities": _YELLOW, "scales": _CYAN, "quats": _PURPLE,
}  # fmt: skip
RUN_COLORS: Final = (_BLUE, _RED, _GREEN, _YELLOW, _CYAN, _PURPLE)
_RUN_STYLES: Final = ("-", "--", ":")

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False)
class SheetRow:
    """One view of the contact sheet: images at HR size by column, "ours" among them, and what to say below ours."""

    name: str
    images: Mapping[str, Float[Tensor, "H W 3"]]
    truth: Float[Tensor, "H W 3"] | None
    caption: str


def contact_sheet(path: Path, rows: Sequence[SheetRow], title: str) -> None:
    """One row a view: its images by column, and where the truth is known the truth and the error of ours."""
    if not rows:
        return
    columns = list(rows[0].images)
    if any(row.truth is not None for row in rows):
        columns += ["ground truth", "error of ours"]
    height = max(image.shape[0] for row in rows for image in row.images.values())
    width = max(image.shape[1] for row in rows for image in row.images.values())
    times = _magnification(width)
    cell_w, cell_h = round(width * times), round(height * times)
    left, top = 2 * _LINE, 5 * _LINE
    right = left + len(columns) * (cell_w + _GAP)
    with_scale = "error of ours" in columns
    page = _Page(right + 5 * _LINE * with_scale, top + len(rows) * (cell_h + 2 * _LINE + _GAP), title)
    for i, column in enumerate(columns):
        page.text(left + i * (cell_w + _GAP) + cell_w / 2, top - _LINE / 2, column, size=10, ha="center")

    error: AxesImage | None = None
    for j, row in enumerate(rows):
        y = top + j * (cell_h + 2 * _LINE + _GAP)
        page.text(_LINE, y + cell_h / 2, row.name, rotation=90, ha="center", va="center", color=_FAINT)
        shown = {name: _pixels(image) for name, image in row.images.items()}
        if row.truth is not None:
            shown["ground truth"] = _pixels(row.truth)
            shown["error of ours"] = error_map(shown["ours"], shown["ground truth"])
        for i, column in enumerate(columns):
            x = left + i * (cell_w + _GAP)
            if column in shown:
                _, picture = page.picture(x, y, shown[column], times)
                error = picture if column == "error of ours" else error
            if column == "ours":
                page.text(x + cell_w / 2, y + cell_h + _LINE, row.caption, ha="center")
    if error is not None:
        page.scale(right, top, cell_h, error, "mean |difference| over RGB")
    page.save(path)


def evenly(items: Sequence[Item], count: int) -> Sequence[Item]:
    """At most so many, spread over all of them: a few views that stand for many."""
    return items[:: max(1, math.ceil(len(items) / count))] if count else ()


def error_map(image: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Mean absolute difference over RGB, in [0, 1]."""
    return np.asarray(np.abs(image - truth).mean(axis=-1))


def curves(path: Path, history: Sequence[Mapping[str, float]], milestones: Mapping[str, int], title: str) -> None:
    """What happened over iterations; numbered marks are the method's milestones, named below.

    Args:
        history: one row an iteration with `t`; a column that is missing, or NaN, is not drawn.
        milestones: name -> iteration; those after the last row are left out.
    """
    figure, axes = _figure(2, 3, 15, 8)
    losses, quality, structure, conflict, correction, detail = axes.flatten()

    losses.set_title("losses (running mean)")
    for column, name, color in (
        ("loss_lr", "LR", _BLUE), ("loss_base", "HR base", _RED), ("loss_hf", "HR high frequency", _GREEN),
    ):  # fmt: skip
        _draw(losses, history, column, name, color, smooth=True)
    if losses.lines:
        losses.set_yscale("log")
    quality.set_title("PSNR, dB")
    _draw(quality, history, "psnr_train_lr", "training views, LR (running mean)", _GREY, smooth=True)
    _draw(quality, history, "psnr_test", "test views, HR", _RED, marker="o")
    structure.set_title("number of Gaussians")
    _draw(structure, history, "n_gaussians", "", _INK)
    conflict.set_title("share of Gaussians in conflict, before correction")
    for group, color in _GROUP_COLORS.items():
        _draw(conflict, history, f"conflict_{group}", group, color, smooth=True, width=0.9)
    _draw(conflict, history, "conflict", "all together", _INK, smooth=True)
    correction.set_title("correction")
    for column, name, color in (
        ("corrected", "share corrected", _INK), ("mean_q", "mean reliability q", _CYAN),
        ("mean_omega", "mean ω of the corrected", _PURPLE),
    ):  # fmt: skip
        _draw(correction, history, column, name, color, smooth=True)
    correction.set_ylim(0, 1.35)  # the legend stays above the lines
    correction.set_yticks(np.linspace(0, 1, 6))
    detail.set_title("mean |detail feature|, RGB")
    _draw(detail, history, "detail_abs", "", _INK)

    named = []
    last = max((row["t"] for row in history), default=1)
    ordered = sorted(((name, t) for name, t in milestones.items() if t <= last), key=lambda mark: mark[1])
    for number, (t, marks) in enumerate(groupby(ordered, key=lambda mark: mark[1]), start=1):
        named.append(f"{number}  {', '.join(name for name, _ in marks)}, {t:,}")
        for axis in (a for a in axes.flatten() if a.lines):
            axis.axvline(t, color=_FAINT, linewidth=0.8, linestyle=":", zorder=0)
            axis.text(t, 0.985, f" {number}", fontsize=7, color=_FAINT, va="top", transform=axis.get_xaxis_transform())
    for axis in axes.flatten():
        axis.set_xlim(0, last)
        _finish(axis, legend="upper right" if axis is correction else "best")
    detail.set_ylim(bottom=0)
    figure.supxlabel("      ".join(("iteration", *named)), fontsize=9, color=_INK)
    _head(figure, title)
    _save(figure, path)


def comparison(
    path: Path, tiles: Mapping[str, Float[np.ndarray, "H W 3"]], captions: Mapping[str, str], title: str
) -> None:
    """The same view of several runs side by side; below each the part where they differ most, enlarged.

    Args:
        tiles: name -> image in [0, 1], all of one size.
        captions: name -> what to say below it.
    """
    if not tiles:
        return
    height, width = next(iter(tiles.values())).shape[:2]
    times = _magnification(width)
    cell_w, cell_h = round(width * times), round(height * times)
    crop = _where_they_differ(np.stack(list(tiles.values())))
    rows, columns = crop
    enlarged = cell_w / (columns.stop - columns.start)
    crop_h = round((rows.stop - rows.start) * enlarged)
    names = {name: textwrap.wrap(name, width=cell_w // 7) or [""] for name in tiles}
    head = max(map(len, names.values())) * _LINE
    block = head + cell_h + crop_h + 3 * _LINE + 2 * _GAP
    abreast = min(_ABREAST, len(tiles))
    page = _Page(_GAP + abreast * (cell_w + _GAP), 2 * _LINE + math.ceil(len(tiles) / abreast) * block, title)
    for i, (name, pixels) in enumerate(tiles.items()):
        x = _GAP + i % abreast * (cell_w + _GAP)
        y = 3 * _LINE + i // abreast * block + head
        for j, words in enumerate(reversed(names[name])):
            page.text(x + cell_w / 2, y - _LINE * (j + 0.5), words, size=10, ha="center")
        axis, _ = page.picture(x, y, pixels, times)
        _outline(axis, crop)
        page.picture(x, y + cell_h + _GAP, pixels[crop], enlarged)
        page.text(x + cell_w / 2, y + cell_h + _GAP + crop_h + _LINE, captions.get(name, ""), ha="center")
    page.save(path)


def overlay(path: Path, runs: Mapping[str, Sequence[Mapping[str, float]]], title: str) -> None:
    """PSNR, conflict and number of Gaussians of several runs over iterations, by name of the run."""
    figure, axes = _figure(1, 3, 15, 4.6)
    quality, conflict, structure = axes.flatten()
    quality.set_title("PSNR of test views, dB")
    conflict.set_title("conflict ratio, before correction (running mean)")
    structure.set_title("number of Gaussians")
    for i, (name, history) in enumerate(runs.items()):
        color = RUN_COLORS[i % len(RUN_COLORS)]
        style = _RUN_STYLES[i // len(RUN_COLORS) % len(_RUN_STYLES)]
        _draw(quality, history, "psnr_test", name, color, marker="o", linestyle=style)
        _draw(conflict, history, "conflict", name, color, smooth=True, linestyle=style)
        _draw(structure, history, "n_gaussians", name, color, linestyle=style)
    _share_legend(figure, axes)
    _head(figure, title)
    _save(figure, path)


def over_seconds(path: Path, runs: Mapping[str, Sequence[Mapping[str, float]]], title: str) -> None:
    """PSNR of several runs over the seconds that they trained, by name of the run."""
    figure, axes = _figure(1, 1, 9, 5)
    axes[0, 0].set_title("PSNR of test views, dB, over seconds of training")
    for i, (name, history) in enumerate(runs.items()):
        color = RUN_COLORS[i % len(RUN_COLORS)]
        style = _RUN_STYLES[i // len(RUN_COLORS) % len(_RUN_STYLES)]
        _draw(axes[0, 0], history, "psnr_test", name, color, marker="o", linestyle=style, over="seconds")
    _share_legend(figure, axes)
    _head(figure, title)
    _save(figure, path)


def _share_legend(figure: Figure, axes: Any) -> None:
    """One legend below all of the axes."""
    known = {
        text: line for axis in axes.flatten() for line, text in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    for axis in axes.flatten():
        _finish(axis, legend=None)
    if known:
        wrapped = [textwrap.fill(name, width=60) for name in known]
        figure.legend(
            known.values(), wrapped, fontsize=9, frameon=False, loc="outside lower center", ncols=min(3, len(known))
        )


class _Page:
    """A figure laid out in whole pixels from the top left."""

    def __init__(self, width: int, height: int, title: str) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure as NewFigure

        self.width, self.height = width, height
        self.figure = NewFigure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        FigureCanvasAgg(self.figure)  # draws without a display, and without pyplot's global state
        self.text(_GAP, 1.5 * _LINE, title, size=12)

    def picture(self, x: int, y: int, pixels: np.ndarray, times: float) -> tuple[Axes, AxesImage]:
        """RGB, or an error map in its colours, `times` larger; (x, y) is its top left corner."""
        height, width = (round(size * times) for size in pixels.shape[:2])
        axis = self._axes(x, y, width, height)
        axis.set_axis_off()
        picture = axis.imshow(
            pixels, aspect="auto", cmap="magma", vmin=0, vmax=_ERROR_MAX,
            interpolation="nearest" if times >= 1 else "antialiased", interpolation_stage="rgba",
        )  # fmt: skip
        return axis, picture

    def scale(self, x: int, y: int, height: int, picture: AxesImage, label: str) -> None:
        """The colours of an error map, 12 px wide, with its numbers at the right."""
        bar = self.figure.colorbar(picture, cax=self._axes(x, y, 12, height), extend="max", extendfrac=0.03)
        bar.set_label(label, fontsize=8, color=_INK)
        bar.ax.tick_params(labelsize=8, colors=_INK)
        bar.outline.set_visible(False)

    def text(self, x: float, y: float, words: str, *, size: float = 8.5, **style: Any) -> None:
        """Words whose middle line, unless `va` says otherwise, is y."""
        place = {"ha": "left", "va": "center", "color": _INK, **style}
        self.figure.text(x / self.width, 1 - y / self.height, words, fontsize=size, **place)

    def save(self, path: Path) -> None:
        _save(self.figure, path)

    def _axes(self, x: int, y: int, width: int, height: int) -> Axes:
        return self.figure.add_axes(
            (x / self.width, 1 - (y + height) / self.height, width / self.width, height / self.height)
        )


def _magnification(width: int) -> float:
    """A whole number for images up to `_WIDE`, so that pixels stay squares; wider ones are reduced."""
    return math.ceil(_NARROW / width) if width <= _WIDE else _WIDE / width


def _where_they_differ(stack: Float[np.ndarray, "K H W 3"]) -> tuple[slice, slice]:
    """The window, a `_CROP`-th of the image each way, with the largest spread over K; the centre if there is none."""
    spread = stack.std(axis=0).mean(axis=-1)
    h, w = (max(1, size // _CROP) for size in spread.shape)
    tops, lefts = (
        range(0, size - part + 1, max(1, part // 4)) for size, part in zip(spread.shape, (h, w), strict=True)
    )
    windows = [(slice(top, top + h), slice(left, left + w)) for top in tops for left in lefts]
    if not spread.any():
        return windows[len(windows) // 2]
    return max(windows, key=lambda window: float(spread[window].sum()))


def _outline(axis: Axes, crop: tuple[slice, slice]) -> None:
    from matplotlib.patches import Rectangle

    rows, columns = crop
    corner = (columns.start - 0.5, rows.start - 0.5)
    axis.add_patch(
        Rectangle(corner, columns.stop - columns.start, rows.stop - rows.start, fill=False, color="white", linewidth=1)
    )


def _figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as NewFigure

    figure = NewFigure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _draw(
    axis: Axes, history: Sequence[Mapping[str, float]], column: str, label: str, color: str, *,
    smooth: bool = False, marker: str | None = None, width: float = 1.4, linestyle: str = "-", over: str = "t",
) -> None:  # fmt: skip
    points = [(row[over], row[column]) for row in history if over in row and math.isfinite(row.get(column, math.nan))]
    if not points:
        return
    t, values = np.array(points).T
    if smooth:
        window = max(1, len(values) // 50)
        values = np.convolve(values, np.ones(window) / window, mode="valid")
        t = t[window - 1 :]
    axis.plot(t, values, label=label, color=color, linewidth=width, marker=marker, markersize=3.5, linestyle=linestyle)


def _finish(axis: Axes, *, legend: Literal["best", "upper right"] | None = "best") -> None:
    """Recede everything but the data, and say so where there is none."""
    axis.title.set_fontsize(10)
    axis.title.set_color(_INK)
    axis.tick_params(which="both", labelsize=8, colors=_FAINT)
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set_color("#cccccc")
    if not axis.lines:
        axis.text(0.5, 0.5, "not measured", fontsize=9, color=_FAINT, ha="center", transform=axis.transAxes)
        axis.set_xticks([])
        axis.set_yticks([])
        return
    axis.grid(alpha=0.25, linewidth=0.5)
    if legend is not None and axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8, loc=legend, framealpha=0.8, edgecolor="none")


def _head(figure: Figure, title: str) -> None:
    figure.suptitle(title, fontsize=12, color=_INK, x=0.01, ha="left")


def _pixels(image: Float[Tensor, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return np.asarray(image.detach().clamp(0, 1).cpu().numpy())


def _save(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    write_bytes(path, buffer.getvalue())
