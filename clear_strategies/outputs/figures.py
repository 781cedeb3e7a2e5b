"""What all figures share: colours, and matplotlib figures that need no display."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from clear_strategies.data.photo_files import PNG_LEVEL
from clear_strategies.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI: Final = 100

INK, FAINT, RULE = "#222222", "#888888", "#cccccc"
# Paul Tol's bright scheme, which colour-blind readers can tell apart too.
BLUE, RED, GREEN, YELLOW, CYAN, PURPLE = "#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377"

AS_WRITTEN: Final[dict[str, Any]] = {"parse_math": False}
"""Style of a text with names of the user's: matplotlib would read what lies between two $ as mathematics."""

Item = TypeVar("Item")


def spaced(items: Sequence[Item], count: int) -> Sequence[Item]:
    """Every n-th item, at most `count` in all: the views that a figure shows of many."""
    return items[:: math.ceil(len(items) / count) or 1] if count else ()


def new_figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    """A figure of `width` x `height` inches and its axes [rows, columns], without pyplot's global state."""
    from matplotlib.figure import Figure as NewFigure

    figure = NewFigure(figsize=(width, height), dpi=DPI, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def set_title(figure: Figure, title: str) -> None:
    figure.suptitle(title, fontsize=12, color=INK, x=0.01, ha="left", **AS_WRITTEN)


def save_png(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, pil_kwargs={"compress_level": PNG_LEVEL})
    write_bytes(path, buffer.getvalue())
