"""contact_sheet.png: a few views of one run beside the LR photo, the prior, the truth and the error.

Images are laid out in whole pixels: a render is shown pixel for pixel, a small one at a whole multiple, because a resized
image does not show the detail that this library is about.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float
from torch import Tensor

from clear_strategies.outputs.figures import FAINT, GAP, LINE, PixelPage, error_map, magnification, save_png

if TYPE_CHECKING:
    from matplotlib.image import FigureImage

OWN_PHOTO: Final = "LR, SR prior (and bicubic in the tables) show the test view's own photo, which training never sees."
TRAINED_ON: Final = (
    "These are training views, since there are no test views: the run has seen their photos and SR images."
)


@dataclass(frozen=True, slots=True, eq=False)
class SheetRow:
    """One view: its images at HR size by their column, "ours" among them, and the line below each."""

    name: str
    images: Mapping[str, Float[Tensor, "H W 3"]]
    truth: Float[Tensor, "H W 3"] | None
    captions: Mapping[str, str] = field(default_factory=dict)


def write_contact_sheet(path: Path, rows: Sequence[SheetRow], title: str, note: str = OWN_PHOTO) -> None:
    """Draw one row per view: its images and, where the truth is known, the truth and the error of ours. `note` stands below."""
    columns = list(rows[0].images)
    if any(row.truth is not None for row in rows):
        columns += ["ground truth", "error of ours"]
    height = max(image.shape[0] for row in rows for image in row.images.values())
    width = max(image.shape[1] for row in rows for image in row.images.values())
    times = magnification(width)
    cell_w, cell_h = round(width * times), round(height * times)
    left, top = 2 * LINE, 5 * LINE
    right = left + len(columns) * (cell_w + GAP)
    with_bar = "error of ours" in columns
    page = PixelPage(right + 5 * LINE * with_bar, top + len(rows) * (cell_h + 2 * LINE + GAP) + LINE, title)
    for i, column in enumerate(columns):
        page.text(left + i * (cell_w + GAP) + cell_w / 2, top - LINE / 2, column, size=10, ha="center")

    error: FigureImage | None = None
    for j, row in enumerate(rows):
        y = top + j * (cell_h + 2 * LINE + GAP)
        page.text(LINE, y + cell_h / 2, row.name, rotation=90, ha="center", va="center", color=FAINT)
        pixels = {name: _pixels(image) for name, image in row.images.items()}
        if row.truth is not None:
            pixels["ground truth"] = _pixels(row.truth)
            pixels["error of ours"] = error_map(pixels["ours"], pixels["ground truth"])
        for i, column in enumerate(columns):
            x = left + i * (cell_w + GAP)
            if column in pixels:
                image = page.image(x, y, pixels[column], times)
                error = image if column == "error of ours" else error
            if column in row.captions:
                page.text(x + cell_w / 2, y + cell_h + LINE, row.captions[column], ha="center")
    page.text(left, page.height - LINE, note, color=FAINT)
    if error is not None:
        page.colour_bar(right, top, cell_h, error, "mean |difference| over RGB")
    save_png(page.figure, path)


def _pixels(image: Float[Tensor, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return np.asarray(image.detach().clamp(0, 1).cpu().numpy())
