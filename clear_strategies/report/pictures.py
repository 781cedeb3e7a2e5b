"""The picture of a report: one test view of all methods of a scene."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from clear_strategies.outputs.figures import GAP, LINE, PixelPage, magnification, save_png

_ABREAST: Final = 6  # runs in one line
_CROP: Final = 4  # the enlarged window is this many times smaller than the image, on each side


def write_comparison(
    path: Path,
    tiles: Mapping[str, Float[np.ndarray, "H W 3"]],
    captions: Mapping[str, str],
    title: str,
    truth: Float[np.ndarray, "H W 3"] | None = None,
) -> None:
    """Draw the same view of several runs and the truth, and below each the window where the runs differ most, enlarged.

    Args:
        tiles: name of the run -> image in [0, 1]; at least one, all of one size.
        captions: name of the run -> the line below its images.
    """
    height, width = next(iter(tiles.values())).shape[:2]
    times = magnification(width)
    cell_w, cell_h = round(width * times), round(height * times)
    window = rows, columns = _where_they_differ(np.stack(list(tiles.values())))
    tiles = tiles if truth is None else {**tiles, "truth": truth}
    window_h, window_w = rows.stop - rows.start, columns.stop - columns.start
    enlarged = cell_w / window_w
    enlarged_h = round(window_h * enlarged)
    names = {name: textwrap.wrap(name, width=cell_w // 7) or [""] for name in tiles}
    head = max(map(len, names.values())) * LINE
    block = head + cell_h + enlarged_h + 3 * LINE + 2 * GAP
    abreast = min(_ABREAST, len(tiles))
    page = PixelPage(GAP + abreast * (cell_w + GAP), 2 * LINE + math.ceil(len(tiles) / abreast) * block, title)
    for i, (name, pixels) in enumerate(tiles.items()):
        x = GAP + i % abreast * (cell_w + GAP)
        y = 3 * LINE + i // abreast * block + head
        for j, words in enumerate(reversed(names[name])):
            page.text(x + cell_w / 2, y - LINE * (j + 0.5), words, size=10, ha="center")
        page.image(x, y, pixels, times)
        page.frame(x + times * columns.start, y + times * rows.start, times * window_w, times * window_h, "white")
        page.image(x, y + cell_h + GAP, pixels[window], enlarged)
        page.text(x + cell_w / 2, y + cell_h + GAP + enlarged_h + LINE, captions.get(name, ""), ha="center")
    save_png(page.figure, path)


def _where_they_differ(stack: Float[np.ndarray, "K H W 3"]) -> tuple[slice, slice]:
    """The window with the largest standard deviation over K; the central one where all images are equal."""
    deviation = stack.std(axis=0).mean(axis=-1)
    h, w = (max(1, size // _CROP) for size in deviation.shape)
    tops, lefts = (
        range(0, size - part + 1, max(1, part // 4)) for size, part in zip(deviation.shape, (h, w), strict=True)
    )
    windows = [(slice(top, top + h), slice(left, left + w)) for top in tops for left in lefts]
    if not deviation.any():
        return windows[len(windows) // 2]
    return max(windows, key=lambda window: float(deviation[window].sum()))
