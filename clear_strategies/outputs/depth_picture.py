"""depth.png of a training view: its LR photo, the depth that stereo found in it, and how sure that is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.outputs import figures

_EXTREMES: Final = (0.02, 0.98)  # quantiles of depth at the ends of the colours


def write_depth(path: Path, photo: Photo, found: DepthMap, title: str) -> None:
    """Draw photo, depth and confidence side by side, each with its legend; grey is unknown.

    Args:
        photo: the view at LR. found: on its pixel grid.
    """
    figure, axes = figures.new_figure(1, 3, 15, 1.5 + 4.2 * photo.camera.height / photo.camera.width)
    left, middle, right = axes.flatten()
    left.imshow(photo.image.cpu().clamp(0, 1).numpy())
    left.set_title("LR photo")
    _draw(middle, found.depth.where(found.known, float("nan")), "viridis_r", _ends(found))
    middle.set_title(f"depth, world units; known at {found.coverage:.0%}, grey elsewhere")
    _draw(right, found.confidence.where(found.known, float("nan")), "viridis", (0.0, 1.0))
    right.set_title("confidence, 0 to 1")
    for axis in (left, middle, right):
        axis.set_xticks([])
        axis.set_yticks([])
    figures.set_title(figure, title)
    figures.save_png(figure, path)


def _ends(found: DepthMap) -> tuple[float, float]:
    known = found.depth[found.known]
    if len(known) == 0:
        return 0.0, 1.0
    low, high = (float(known.quantile(q)) for q in _EXTREMES)
    return low, max(high, low * (1 + 1e-6))


def _draw(axis: Any, values: Any, colors: str, ends: tuple[float, float]) -> None:
    axis.set_facecolor(figures.RULE)
    shown = axis.imshow(values.cpu().numpy(), cmap=colors, vmin=ends[0], vmax=ends[1], interpolation="nearest")
    axis.figure.colorbar(shown, ax=axis, shrink=0.8)
