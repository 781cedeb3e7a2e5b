"""`clear-strategies render RUN`: render a saved run or a PLY file, as a video along its cameras or pictures from given ones."""

from __future__ import annotations

import argparse
import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from clear_strategies import console
from clear_strategies.commands import parser_of, path_of, positive
from clear_strategies.errors import SettingError, counted

if TYPE_CHECKING:
    from clear_strategies.jobs.saved import SavedSplat
    from clear_strategies.viewing.look import Pixels
    from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_LOOP: Final = "cameras"  # the --path that is a video
_LONGEST: Final = 1280  # px, longer edge of a video without --width
_SAMPLED: Final = 5  # approximate number of cameras that the range of depths is taken from


def main(arguments: Sequence[str]) -> None:
    options = _parser().parse_args(arguments)
    console.show(verbose=options.verbose)
    import torch

    from clear_strategies.core.images import to_bytes
    from clear_strategies.data.photo_files import write_png
    from clear_strategies.jobs.saved import open_splat
    from clear_strategies.outputs.figures import spaced
    from clear_strategies.viewing.cameras import at_most
    from clear_strategies.viewing.look import colored, depth_range, write_video

    splat = open_splat(options.run, options.rasterizer)
    _log.info("%s", splat.source)
    painter = splat.painter
    cameras, width = cameras_of(splat, options.path, options.frames), options.width
    if width is not None:
        cameras = {name: c.resized(width, max(1, round(c.height * width / c.width))) for name, c in cameras.items()}
    if options.path == _LOOP:
        cameras = {name: at_most(c, None if width is not None else _LONGEST) for name, c in cameras.items()}
    kinds: dict[str, Callable[[Camera], Pixels]] = {"": lambda camera: to_bytes(painter.color(camera))}
    if options.depth:
        near, far = depth_range(torch.cat([painter.depth(c).flatten() for c in spaced([*cameras.values()], _SAMPLED)]))
        _log.info("depth: %.3g (bright) to %.3g (dark) world units, grey where nothing is", near, far)
        kinds["depth"] = lambda camera: colored(painter.depth(camera), near, far)
    out = options.out or splat.folder / "rendered"
    for kind, draw in kinds.items():
        began = time.perf_counter()
        if options.path == _LOOP:
            made = out / f"{_LOOP}{kind and f'_{kind}'}.mp4"
            write_video(made, map(draw, cameras.values()))
        else:
            made = out / kind
            for name, camera in cameras.items():
                write_png(made / f"{name}.png", torch.from_numpy(draw(camera)) / 255)
        _log.info("%s: %s in %.1f s", made, counted(len(cameras), "picture"), time.perf_counter() - began)


def cameras_of(splat: SavedSplat, path: str, frames: int) -> dict[str, Camera]:
    """The cameras that `--path` names, by the names of their pictures."""
    from clear_strategies.data.view_names import file_stems
    from clear_strategies.viewing.cameras import read_cameras, through

    if path == _LOOP:
        if not splat.cameras:
            _log.warning("no cameras.json lies with %s: the path sways in front of the splat.", splat.folder)
        return {str(i): camera for i, camera in enumerate(through(splat.poses(), frames))}
    cameras = splat.cameras
    if path in ("train", "test"):
        chosen = [saved for saved in splat.cameras if saved.split == path]
        if not chosen:
            raise SettingError(f"--path {path}: {splat.folder} has no {path} cameras. Try --path {_LOOP}.")
    elif (file := path_of(path)).is_file():
        chosen = cameras = read_cameras(file)
    else:
        raise SettingError(f"--path: must be {_LOOP}, train, test or a file of cameras, got {path}.")
    count = Counter(saved.name for saved in cameras)  # Inria's names lack suffixes, so they may not be unique
    names = {saved: f"{saved.name}_{i}" if count[saved.name] > 1 else saved.name for i, saved in enumerate(cameras)}
    stems = file_stems(names.values())
    return {stems[names[saved]]: saved.camera for saved in chosen}


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("render", "Render a saved run, or a PLY file: a video, or pictures from given cameras.")
    which = "cameras: a video of a smooth loop through the training cameras (default); train, test: pictures from these"
    which += " cameras; or the cameras.json of a run or of Inria's 3DGS: pictures from its cameras"
    parser.add_argument("--path", default=_LOOP, metavar="WHICH", help=which)
    parser.add_argument("--out", type=path_of, metavar="FOLDER", help="where the files go (default: RUN/rendered)")
    parser.add_argument("--frames", type=positive, default=120, help="of the video (%(default)s)")
    width = f"width of the pictures (default: that of the HR camera, of a video at most {_LONGEST})"
    parser.add_argument("--width", type=positive, metavar="PX", help=width)
    parser.add_argument("--depth", action="store_true", help="depth as well, in colours")
    return parser
