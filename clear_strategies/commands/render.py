"""`clear-strategies render RUN`: pictures and a video of a saved run, or of any PLY file, along a camera path."""

from __future__ import annotations

import argparse
import collections
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from clear_strategies import console
from clear_strategies.commands.options import parser_of, positive
from clear_strategies.errors import SettingError
from clear_strategies.viewing import FPS

if TYPE_CHECKING:
    from clear_strategies.jobs.saved import SavedSplat
    from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_FRAMES: Final = 120
_STILLS: Final = ("train", "test")  # of --path: cameras that pictures are taken from, without a video
_LONGEST: Final = 1280  # px, of a video where --width asks for nothing


def main(arguments: Sequence[str]) -> None:
    """Render what the arguments ask for."""
    options = _parser().parse_args(arguments)
    console.show(verbose=options.verbose)
    from clear_strategies.jobs.saved import open_splat
    from clear_strategies.viewing import film, video
    from clear_strategies.viewing.look import Look

    began = time.perf_counter()
    splat = open_splat(options.run, options.rasterizer)
    _log.info("%s", splat.source)
    look = Look(
        sh=not options.no_sh, detail=not options.no_detail, filter_3d=not options.no_filter, mip=not options.no_mip
    )
    if splat.baked and (options.no_detail or options.no_filter):
        _log.warning(
            "--no-detail and --no-filter have no effect: a PLY file holds f_det and the filter in its Gaussians."
        )
    names, where, fps = cameras_of(splat, options)
    out = options.out or splat.folder / "rendered"
    kinds = {"": film.color_frames(splat.painter, where, look)}
    if options.depth:
        scale = film.DepthScale.of(splat.painter, where, look)
        _log.info("depth: %.3g (bright) to %.3g (dark) world units, grey where nothing is", scale.near, scale.far)
        kinds["depth"] = (scale.picture(splat.painter.depth(camera, look)) for camera in where)
    written: list[Path] = []
    for kind, frames in kinds.items():
        if options.images or options.path in _STILLS:
            pictures = [out / kind / f"{name}.png" for name in names]
            frames = film.saving(frames, pictures)  # noqa: PLW2901 - the same frames
            written += pictures
        if options.path in _STILLS:
            collections.deque(frames, maxlen=0)
        else:
            written.append(out / f"{'_'.join(part for part in (Path(options.path).stem, kind) if part)}.mp4")
            video.write_video(written[-1], frames, fps=fps)
    shown = written if len(written) <= 4 else [*written[:2], *written[-2:]]
    _log.info("%s", "\n".join(f"  {path}" for path in shown))
    _log.info("%d views, %d files in %.1f s", len(where) * len(kinds), len(written), time.perf_counter() - began)


def cameras_of(splat: SavedSplat, options: argparse.Namespace) -> tuple[list[str], list[Camera], float]:
    """Names, cameras and frames per second of what `--path` names.

    Raises:
        DataError, SettingError: it names no cameras, or a file that cannot be read.
    """
    from clear_strategies.data.view_names import file_stem
    from clear_strategies.data.view_settings import resized
    from clear_strategies.viewing import cameras

    path, fps = str(options.path), None
    if path in _STILLS:
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
    if path not in _STILLS:
        views = [cameras.at_most(c, None if options.width is not None else _LONGEST) for c in views]
        if len({(c.width, c.height) for c in views}) > 1:
            views = [cameras.framed(c, views[0].width, views[0].height) for c in views]
            _log.warning("the cameras have different sizes; all frames have the first one's.")
    return names, views, float(options.fps or fps or FPS)


def _of_path(splat: SavedSplat, path: str, frames: int) -> tuple[list[Camera], float | None]:
    from clear_strategies.viewing import cameras, paths

    poses = splat.poses()
    if path == "cameras":
        if not splat.cameras:
            _log.warning("no cameras.json lies with %s: the path sways in front of the splat.", splat.folder)
        return paths.through(poses, frames), None
    if not Path(path).is_file():
        raise SettingError(f"--path: must be cameras, train, test or a file of cameras, got {path}.")
    return cameras.read_path(Path(path), (poses[0].width, poses[0].height))


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("render", "Render a saved run, or a PLY file, along a camera path.")
    parser.add_argument(
        "--path",
        default="cameras",
        metavar="WHICH",
        help="cameras: a smooth loop through the training cameras (default); train, test: pictures from these cameras; or a "
        "file: cameras.json, transforms.json, a path saved in a viewer",
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where the files go (default: RUN/rendered)")
    parser.add_argument("--frames", type=positive(int), default=_FRAMES, help="of the path (%(default)s)")
    parser.add_argument("--fps", type=positive(float), help=f"frames per second ({FPS:g}, or the file's)")
    parser.add_argument(
        "--width", type=positive(int), metavar="PX",
        help=f"width of the pictures (default: that of the HR camera, of a video at most {_LONGEST})",
    )  # fmt: skip
    parser.add_argument("--depth", action="store_true", help="depth as well, in colours")
    parser.add_argument("--images", action="store_true", help="every frame as PNG, too")
    parser.add_argument("--no-detail", action="store_true", help="without f_det, as LR renders are")
    parser.add_argument("--no-filter", action="store_true", help="without the 3D filter of Mip-Splatting")
    parser.add_argument("--no-mip", action="store_true", help="with 3DGS's blur in place of Mip-Splatting's 2D filter")
    parser.add_argument("--no-sh", action="store_true", help="with colours that do not depend on the direction")
    return parser
