"""path.mp4, path.gif, splat.html and depth/: a run as it looks between its cameras and from them."""

from __future__ import annotations

import collections
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from clear_strategies.core.view import View
from clear_strategies.data.view_names import file_stem
from clear_strategies.viewing import FPS, cameras, film, page, paths, video
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera, Color

_log = logging.getLogger(__name__)

_LONGEST: Final = 960  # px: a frame takes a fraction of a second, and the file a few MB


def write_loop(folder: Path, train: Sequence[Camera], painter: Painter, frames: int) -> None:
    """Write the video of a loop through the training cameras. Without imageio-ffmpeg, log a message instead."""
    if not frames:
        return
    if (missing := video.missing()) is not None:
        _log.info("no video of the camera path is written: %s.", missing)
        return
    began = time.perf_counter()
    path = [cameras.at_most(camera, _LONGEST) for camera in paths.through(train, frames)]
    video.write_videos([folder / "path.mp4", folder / "path.gif"], film.color_frames(painter, path), fps=FPS)
    _log.debug(
        "path.mp4, path.gif: %d frames of %dx%d in %.1f s (fit.video=0 writes none).",
        frames, path[0].width, path[0].height, time.perf_counter() - began,
    )  # fmt: skip


def write_depths(folder: Path, views: Sequence[View], painter: Painter) -> None:
    """Write the depth of at least one view as rendered, all in the same colours, each with a legend."""
    shown = [cameras.at_most(view.hr.camera, _LONGEST) for view in views]
    files = [folder / f"{file_stem(view.name)}.png" for view in views]
    collections.deque(film.saving(film.depth_frames(painter, shown), files), maxlen=0)


def write_splat_page(
    folder: Path, train: Sequence[Camera], painter: Painter, most: int, title: str, background: Color
) -> None:
    """Write splat.html. Where the field has more Gaussians than `most`, or the page cannot be made, log why instead.

    Args:
        most: 0: write no page, without a message.
    """
    count = len(painter.field)
    if most == 0:
        return
    if (missing := page.missing()) is not None:
        _log.info("no %s is written: %s.", page.FILE, missing)
        return
    if count > most:
        _log.info("no %s is written: there are %s Gaussians, fit.page is %s.", page.FILE, f"{count:,}", f"{most:,}")
        return
    began, path = time.perf_counter(), folder / page.FILE
    with page.optional(page.FILE):
        page.write_page(path, painter.field.baked(), train, title, background)
        size, seconds = path.stat().st_size / 1e6, time.perf_counter() - began
        _log.debug("%s: %.1f MB in %.1f s (fit.page=0 writes none).", page.FILE, size, seconds)
