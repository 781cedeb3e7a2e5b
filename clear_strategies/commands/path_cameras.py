"""The cameras that `clear-strategies render --path` names."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from clear_strategies.commands.options import LONGEST, STILLS
from clear_strategies.data.view_names import file_stem
from clear_strategies.data.view_settings import resized
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import SavedSplat
from clear_strategies.viewing import FPS, cameras, paths
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)


def cameras_of(splat: SavedSplat, options: argparse.Namespace) -> tuple[list[str], list[Camera], float]:
    """Names, cameras and frames per second of what `--path` names.

    Raises:
        DataError, SettingError: it names no cameras, or a file that cannot be read.
    """
    path, fps = str(options.path), None
    if path in STILLS:
        chosen = [saved for saved in splat.cameras if saved.split == path]
        if not chosen:
            raise SettingError(f"--path {path}: {splat.folder} has no {path} cameras. Try --path cameras.")
        names = [file_stem(saved.name) for saved in chosen]
        views = [saved.camera for saved in chosen]
    else:
        views, fps = _of_path(splat, path, options.frames)
        names = [f"{i:04d}" for i in range(len(views))]
    if options.width is not None:
        views = [resized(c, options.width, max(1, round(c.height * options.width / c.width))) for c in views]
    if path not in STILLS:
        views = [cameras.at_most(c, None if options.width is not None else LONGEST) for c in views]
        if len({(c.width, c.height) for c in views}) > 1:
            views = [cameras.framed(c, views[0].width, views[0].height) for c in views]
            _log.warning("the cameras have different sizes; all frames have the first one's.")
    return names, views, float(options.fps or fps or FPS)


def _of_path(splat: SavedSplat, path: str, frames: int) -> tuple[list[Camera], float | None]:
    poses = splat.poses()
    if path in ("cameras", "ellipse"):
        if not splat.cameras:
            _log.warning("no cameras.json lies with %s: the path sways in front of the splat.", splat.folder)
        return (paths.through if path == "cameras" else paths.ellipse)(poses, frames), None
    if not Path(path).is_file():
        raise SettingError(f"--path: must be cameras, ellipse, train, test or a file of cameras, got {path}.")
    return cameras.read_path(Path(path), (poses[0].width, poses[0].height))
