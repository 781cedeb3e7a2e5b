"""maps.png and depth.png of a training view: its maps side by side, and the depth that stereo found in it, with legends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo, View
from clear_strategies.outputs.figures import GAP, LINE, PixelPage, Span, magnification, save_png
from clear_strategies.viewing.film import DepthScale

_MEANINGS: Final = {
    "reliability": "reliability R\nhow far the SR image agrees with the LR photo",
    "demand": "demand A\nhow much detail is there to gain",
    "weight": "weight w = R·A\nhow much the SR image's detail counts",
    "conflict": "conflict\n1 where LR and HR gradients point apart",
    "corrected": "corrected\nthe share of the HR gradient that was taken away",
}
_COLUMNS: Final = 4
_TITLE, _BAR = 3 * LINE, 5 * LINE  # px: the height above an image, the width beside it


@dataclass(frozen=True, slots=True, eq=False)
class _Panel:
    """An image below its title; an image of numbers has a colour bar from `span[0]` to `span[1]`."""

    title: str
    image: Float[Tensor, "H W"] | Float[Tensor, "H W 3"]
    colors: str = "viridis"
    span: Span = (0.0, 1.0)


def write_maps_picture(
    path: Path, view: View, maps: Mapping[str, Float[Tensor, "H W"]], means: Mapping[str, float]
) -> None:
    """Draw the LR photo, the SR image and the maps, with one colour bar from 0 to 1.

    Args:
        maps, means: those of `maps.ViewMaps`, by the same names.
    """
    panels = [
        _Panel("LR photo\nwhat the camera saw", view.lr.image),
        _Panel("SR image\nwhat the prior made of it", view.hr.image),
    ]
    panels += [
        _Panel(f"{meaning} (mean {means[name]:.2f})", maps[name]) for name, meaning in _MEANINGS.items() if name in maps
    ]
    title = f"{view.name}: where the SR image is believed, and where the photo overrules it"
    _write(path, title, panels, view.hr.camera.width, last_bar="0: none or never, 1: all or always")


def write_depth(path: Path, photo: Photo, stereo: DepthMap, title: str) -> None:
    """Draw photo, depth and confidence side by side, each with its legend; grey is unknown.

    Args:
        photo: the view at LR. stereo: on its pixel grid.
    """
    depth, confidence = (x.where(stereo.known, torch.nan) for x in (stereo.depth, stereo.confidence))
    scale = DepthScale.spanning(depth)
    panels = [
        _Panel("LR photo", photo.image),
        _Panel(
            f"depth, world units; known at {stereo.coverage:.0%}, grey elsewhere",
            depth,
            "viridis_r",
            (scale.near, scale.far),
        ),
        _Panel("confidence, 0 to 1", confidence),
    ]
    _write(path, title, panels, photo.camera.width)


def _write(path: Path, title: str, panels: Sequence[_Panel], width: int, *, last_bar: str | None = None) -> None:
    """Lay the panels out in rows, all as wide as an image of `width` px is shown.

    Args:
        last_bar: the label of one colour bar for all, beside the last; None: each panel of numbers has its own.
    """
    height, columns = panels[0].image.shape[0] / panels[0].image.shape[1], min(_COLUMNS, len(panels))
    across = round(width * magnification(width))
    down, bar = round(across * height), 0 if last_bar else _BAR
    step_x, step_y = across + bar + GAP, _TITLE + down + GAP
    rows = -(-len(panels) // columns)
    page = PixelPage(GAP + columns * step_x + (_BAR if last_bar else 0), 2 * LINE + rows * step_y, title)
    for i, panel in enumerate(panels):
        x, y = GAP + i % columns * step_x, 2 * LINE + i // columns * step_y
        page.text(x + across / 2, y + _TITLE / 2, panel.title, ha="center")
        numbers = panel.image.dim() == 2
        pixels = np.asarray((panel.image if numbers else panel.image.clamp(0, 1)).detach().cpu().numpy())
        drawn = page.image(x, y + _TITLE, pixels, across / pixels.shape[1], colors=panel.colors, span=panel.span)
        if numbers and (last_bar is None or i == len(panels) - 1):
            page.colour_bar(x + across + GAP, y + _TITLE, down, drawn, last_bar or "", extend="neither")
    save_png(page.figure, path)
