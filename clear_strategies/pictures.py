"""Results to look at: the contact sheet of a run, its curves, and runs side by side."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Float
from torch import Tensor

from clear_strategies.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ERROR_MAX: Final = 0.25  # colour scale of error maps: mean absolute difference over RGB
_GROUP_COLORS: Final = {
    "means": "#4477aa", "sh0": "#ee6677", "shN": "#228833", "opacities": "#ccbb44", "scales": "#66ccee",
    "quats": "#aa3377",
}  # fmt: skip
_INK: Final = "#222222"


@dataclass(frozen=True, slots=True, eq=False)
class SheetRow:
    """One view of the contact sheet: images at HR size by column, `caption` below the render."""

    name: str
    images: Mapping[str, Float[Tensor, "H W 3"]]
    truth: Float[Tensor, "H W 3"] | None
    caption: str


def contact_sheet(path: Path, rows: Sequence[SheetRow], title: str) -> None:
    """One row a view: LR, SR prior, ours, ground truth and the error of ours."""
    if not rows:
        return
    columns = [*rows[0].images, *(["ground truth", "error of ours"] if rows[0].truth is not None else [])]
    height, width = next(iter(rows[0].images.values())).shape[:2]
    cell = 3.2
    figure, axes = _figure(
        len(rows), len(columns), cell * len(columns) + 0.9, (cell * height / width + 0.32) * len(rows) + 0.5
    )
    for row, line in zip(rows, axes, strict=True):
        shown: dict[str, np.ndarray] = {name: _pixels(image) for name, image in row.images.items()}
        if row.truth is not None:
            shown["ground truth"] = _pixels(row.truth)
            shown["error of ours"] = np.abs(shown["ours"] - shown["ground truth"]).mean(-1)
        for column, axis in zip(columns, line, strict=True):
            picture = axis.imshow(shown[column], cmap="magma", vmin=0, vmax=_ERROR_MAX, interpolation="nearest")
            _bare(axis)
            if row is rows[0]:
                axis.set_title(column, fontsize=11, color=_INK)
        line[0].set_ylabel(row.name, fontsize=9, color=_INK)
        line[columns.index("ours")].set_xlabel(row.caption, fontsize=8, color=_INK)
    figure.suptitle(title, fontsize=12, color=_INK, x=0.01, ha="left")
    if rows[0].truth is not None:
        bar = figure.colorbar(picture, ax=axes[:, -1].tolist(), fraction=0.05, pad=0.02)
        bar.set_label("mean |difference| over RGB, [0, 1]", fontsize=8)
        bar.ax.tick_params(labelsize=8)
    _save(figure, path)


def curves(path: Path, history: Sequence[Mapping[str, float]], milestones: Mapping[str, int], title: str) -> None:
    """Losses, PSNR, conflict and number of Gaussians over iterations, with the method's milestones as marks."""
    figure, axes = _figure(2, 2, 12, 7)
    losses, quality, conflict, structure = axes.flatten()
    for name, color in (("loss_lr", "#4477aa"), ("loss_base", "#ee6677"), ("loss_hf", "#228833")):
        _draw(losses, history, name, name.removeprefix("loss_"), color, smooth=True)
    losses.set_title("losses (running mean)")
    losses.set_yscale("log")
    _draw(quality, history, "psnr_train_lr", "training view, LR", "#bbbbbb", smooth=True)
    _draw(quality, history, "psnr_test", "test views, HR", "#ee6677", marker="o")
    quality.set_title("PSNR, dB")
    _draw(conflict, history, "conflict", "all attributes together", _INK, smooth=True)
    for group, color in _GROUP_COLORS.items():
        _draw(conflict, history, f"conflict_{group}", group, color, smooth=True, width=0.8)
    conflict.set_title("share of Gaussians in conflict, before correction")
    _draw(structure, history, "n_gaussians", "Gaussians", _INK)
    structure.set_title("Gaussians")
    if any("mean_omega" in row or "mean_q" in row for row in history):
        right = structure.twinx()
        _draw(right, history, "mean_omega", "mean ω of corrections", "#aa3377", smooth=True)
        _draw(right, history, "mean_q", "mean reliability q", "#66ccee", smooth=True)
        right.set_ylim(0, 1.05)
        right.legend(fontsize=8, loc="center right", frameon=False)
    for axis in axes.flatten():
        axis.grid(alpha=0.25, linewidth=0.5)
        for t in sorted(set(milestones.values())):
            name = ", ".join(mark for mark, at in milestones.items() if at == t)
            axis.axvline(t, color="#999999", linewidth=0.7, linestyle=":")
            if axis is structure:
                axis.text(t, 0.98, f"{name} ", rotation=90, fontsize=6.5, va="top", ha="right", color="#777777",
                          transform=axis.get_xaxis_transform())  # fmt: skip
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=8, frameon=False, loc="best")
    figure.suptitle(title, fontsize=12, color=_INK, x=0.01, ha="left")
    _save(figure, path)


def comparison(
    path: Path, tiles: Mapping[str, Float[np.ndarray, "H W 3"]], captions: Mapping[str, str], title: str
) -> None:
    """The same view of several runs side by side, a central crop enlarged below each."""
    if not tiles:
        return
    height, width = next(iter(tiles.values())).shape[:2]
    figure, axes = _figure(2, len(tiles), 3.1 * len(tiles), 3.1 * height / width * 2 + 0.9)
    top, left = height * 3 // 8, width * 3 // 8
    crop = (slice(top, top + max(1, height // 4)), slice(left, left + max(1, width // 4)))
    for (name, pixels), (above, below) in zip(tiles.items(), axes.T, strict=True):
        above.imshow(pixels)
        below.imshow(pixels[crop], interpolation="nearest")
        above.set_title(name, fontsize=10, color=_INK)
        below.set_xlabel(captions.get(name, ""), fontsize=8, color=_INK)
        _bare(above)
        _bare(below)
    figure.suptitle(title, fontsize=12, color=_INK, x=0.01, ha="left")
    _save(figure, path)


def overlay(path: Path, runs: Mapping[str, Sequence[Mapping[str, float]]], title: str) -> None:
    """PSNR, conflict and Gaussians of several runs over iterations."""
    figure, axes = _figure(1, 3, 15, 4)
    panels = (("psnr_test", "PSNR of test views, dB"), ("conflict", "conflict ratio"), ("n_gaussians", "Gaussians"))
    for axis, (column, label) in zip(axes.flatten(), panels, strict=True):
        for name, history in runs.items():
            _draw(
                axis,
                history,
                column,
                name,
                None,
                smooth=column == "conflict",
                marker="o" if column == "psnr_test" else None,
            )
        axis.set_title(label)
        axis.grid(alpha=0.25, linewidth=0.5)
    axes.flatten()[0].legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=12, color=_INK, x=0.01, ha="left")
    _save(figure, path)


def _figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as NewFigure

    figure = NewFigure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)  # draws without a display, and without pyplot's global state
    return figure, figure.subplots(rows, columns, squeeze=False)


def _draw(
    axis: Axes, history: Sequence[Mapping[str, float]], column: str, label: str, color: str | None, *,
    smooth: bool = False, marker: str | None = None, width: float = 1.4,
) -> None:  # fmt: skip
    points = [(row["t"], row[column]) for row in history if column in row and row[column] is not None]
    points = [(t, value) for t, value in points if math.isfinite(value)]
    if not points:
        return
    t, values = (np.asarray(column) for column in zip(*points, strict=True))
    if smooth:
        window = max(1, len(values) // 50)
        values = np.convolve(values, np.ones(window) / window, mode="valid")
        t = t[window - 1 :]
    axis.plot(t, values, label=label, color=color, linewidth=width, marker=marker, markersize=3.5)


def _bare(axis: Axes) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    for side in axis.spines.values():
        side.set_visible(False)


def _pixels(image: Float[Tensor, "H W 3"]) -> np.ndarray:
    return np.asarray(image.detach().clamp(0, 1).cpu().numpy())


def _save(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_bytes(path, buffer.getvalue())
