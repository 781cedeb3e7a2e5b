"""splat.html of a run, where the page can be made and is no burden."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path

from clear_strategies.viewing import page
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)


def write_splat_page(
    folder: Path,
    train: Sequence[Camera],
    painter: Painter,
    most: int,
    title: str,
    background: tuple[float, float, float],
) -> None:
    """Write splat.html, unless the field has more Gaussians than `most`, or the page cannot be made: a message then says why.

    Args:
        most: 0: write no page, without a message.
    """
    count = len(painter.field)
    if most == 0:
        return
    if (lack := page.missing()) is not None:
        _log.info("no %s is written: %s.", page.FILE, lack)
        return
    if count > most:
        _log.info("no %s is written: there are %s Gaussians, fit.page is %s.", page.FILE, f"{count:,}", f"{most:,}")
        return
    began, path = time.perf_counter(), folder / page.FILE
    try:
        page.write_page(path, painter.field.baked(), train, title, background)
    except OSError as error:  # the rest of the run is worth more than its page
        _log.warning("%s could not be written: %s.", page.FILE, error)
        return
    size, seconds = path.stat().st_size / 1e6, time.perf_counter() - began
    _log.debug("%s: %.1f MB in %.1f s (fit.page=0 writes none).", page.FILE, size, seconds)
