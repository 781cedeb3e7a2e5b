"""maps.png of a training view: its maps side by side, each with its name, what it says and its mean, in the same colours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.outputs import figures

_MEANINGS: Final = {
    "reliability": "reliability R\nhow far the SR image agrees with the LR photo",
    "demand": "demand A\nhow much detail is there to gain",
    "weight": "weight w = R·A\nhow much the SR image's detail counts",
    "conflict": "conflict\n1 where LR and HR gradients point apart",
    "corrected": "corrected\nthe share of the HR gradient that was taken away",
}
_COLORS: Final = "viridis"
_COLUMNS: Final = 4


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


def _array(image: Tensor) -> np.ndarray:
    return np.asarray(image.detach().clamp(0, 1).cpu().numpy())
