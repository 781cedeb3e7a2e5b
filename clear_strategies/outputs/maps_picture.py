"""maps.png and depth.png of a training view: its maps side by side, and the depth that stereo found in it, with legends."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.images import area_mean
from clear_strategies.core.view import DepthMap, Photo, View
from clear_strategies.outputs import figures
from clear_strategies.viewing.film import DepthScale

_MEANINGS: Final = {
    "reliability": "reliability R\nhow far the SR image agrees with the LR photo",
    "demand": "demand A\nhow much detail is there to gain",
    "weight": "weight w = R·A\nhow much the SR image's detail counts",
    "conflict": "conflict\n1 where LR and HR gradients point apart",
    "corrected": "corrected\nthe share of the HR gradient that was taken away",
}
_COLORS: Final = "viridis"
_COLUMNS: Final = 4
_PANEL: Final = 400  # px, the width of one image


def write_maps_picture(
    path: Path, view: View, maps: Mapping[str, Float[Tensor, "H W"]], means: Mapping[str, float]
) -> None:
    """Draw the LR photo, the SR image and the maps, with one colour bar from 0 to 1.

    Args:
        maps, means: those of `maps.ViewMaps`, by the same names.
    """
    shown = {name: maps[name] for name in _MEANINGS if name in maps}
    rows = -(-(2 + len(shown)) // _COLUMNS)
    camera = view.hr.camera
    figure, grid = figures.new_figure(rows, _COLUMNS, 16, rows * (1.0 + 3.6 * camera.height / camera.width))
    axes: list[Any] = list(grid.flatten())
    photos = {"LR photo\nwhat the camera saw": view.lr.image, "SR image\nwhat the prior made of it": view.hr.image}
    for axis, (title, image) in zip(axes, photos.items(), strict=False):
        axis.imshow(_array(image))
        axis.set_title(title, fontsize=9, color=figures.INK)
    drawn = None
    for axis, (name, values) in zip(axes[2:], shown.items(), strict=False):
        drawn = axis.imshow(_array(values), cmap=_COLORS, vmin=0, vmax=1, interpolation="nearest")
        axis.set_title(f"{_MEANINGS[name]} (mean {means[name]:.2f})", fontsize=9, color=figures.INK)
    for axis in axes:
        axis.set_axis_off()
    if drawn is not None:
        figure.colorbar(drawn, ax=axes, shrink=0.6, label="0: none or never, 1: all or always")
    figures.set_title(figure, f"{view.name}: where the SR image is believed, and where the photo overrules it")
    figures.save_png(figure, path)


def write_depth(path: Path, photo: Photo, found: DepthMap, title: str) -> None:
    """Draw photo, depth and confidence side by side, each with its legend; grey is unknown.

    Args:
        photo: the view at LR. found: on its pixel grid.
    """
    figure, axes = figures.new_figure(1, 3, 15, 1.5 + 4.2 * photo.camera.height / photo.camera.width)
    left, middle, right = axes.flatten()
    left.imshow(photo.image.cpu().clamp(0, 1).numpy())
    left.set_title("LR photo")
    depth = found.depth.where(found.known, float("nan"))
    _draw(middle, depth, "viridis_r", DepthScale.spanning(depth))
    middle.set_title(f"depth, world units; known at {found.coverage:.0%}, grey elsewhere")
    _draw(right, found.confidence.where(found.known, float("nan")), "viridis", DepthScale(0.0, 1.0))
    right.set_title("confidence, 0 to 1")
    for axis in (left, middle, right):
        axis.set_xticks([])
        axis.set_yticks([])
    figures.set_title(figure, title)
    figures.save_png(figure, path)


def _draw(axis: Any, values: Float[Tensor, "H W"], colors: str, scale: DepthScale) -> None:
    axis.set_facecolor(figures.RULE)
    shown = axis.imshow(values.cpu().numpy(), cmap=colors, vmin=scale.near, vmax=scale.far, interpolation="nearest")
    axis.figure.colorbar(shown, ax=axis, shrink=0.8)


def _array(image: Float[Tensor, "H W"] | Float[Tensor, "H W 3"]) -> np.ndarray:
    """The image at about the size of its panel, because matplotlib would resample each pixel, twice."""
    factor = max(1, image.shape[1] // _PANEL)
    shown = area_mean(image[..., None] if image.dim() == 2 else image, factor)
    return np.asarray(shown.detach().clamp(0, 1).squeeze(-1).cpu().numpy())
