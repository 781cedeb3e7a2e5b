"""`clear-strategies render RUN`: pictures and videos of a saved run, or of any PLY file, along a camera path."""

from __future__ import annotations

import argparse
import collections
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from clear_strategies import console
from clear_strategies.commands.options import parser_of, positive
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import SavedSplat, open_splat
from clear_strategies.viewing import cameras, film, paths, video
from clear_strategies.viewing.look import Look
from clear_strategies.viewing.video import Frame
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_STILLS: Final = ("train", "test")
_LONGEST: Final = 1280  # px, of a video where --width asks for nothing
_FRAMES: Final = 120


def main(arguments: Sequence[str]) -> None:
    """Render what the arguments ask for.

    Raises:
        DataError, SettingError: the run or an argument cannot be used.
    """
    options = _parser().parse_args(arguments)
    console.show(verbose=options.verbose)
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
    names, where, fps = _cameras(splat, options)
    out = options.out or splat.folder / "rendered"
    written: list[Path] = []
    kinds: dict[str, Callable[..., Iterator[Frame]]] = {"": film.color_frames}
    if options.depth:
        kinds["depth"] = film.depth_frames
    for kind, drawn in kinds.items():
        frames = drawn(splat.painter, where, look)
        if options.images or options.path in _STILLS:
            pictures = [out / kind / f"{name}.png" for name in names]
            frames = film.saving(frames, pictures)
            written += pictures
        if options.path in _STILLS:
            collections.deque(frames, maxlen=0)
        else:
            label = "_".join(part for part in (Path(options.path).stem, kind) if part)
            files = [out / f"{label}.mp4", *([] if options.no_gif else [out / f"{label}.gif"])]
            video.write_videos(files, frames, fps=fps)
            written += files
    shown = written if len(written) <= 4 else [*written[:2], *written[-2:]]
    _log.info("%s", "\n".join(f"  {path}" for path in shown))
    _log.info("%d views, %d files in %.1f s", len(where) * len(kinds), len(written), time.perf_counter() - began)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("render", "Render a saved run, or a PLY file, along a camera path.")
    parser.add_argument(
        "--path",
        default="cameras",
        metavar="WHICH",
        help="cameras: a smooth loop through the training cameras (default); ellipse: around the scene; train, test: "
        "pictures from these cameras; or a file: cameras.json, transforms.json, a path saved in a viewer",
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where the files go (default: RUN/rendered)")
    parser.add_argument("--frames", type=positive(int), default=_FRAMES, help="of the path (%(default)s)")
    parser.add_argument("--fps", type=positive(float), help=f"frames per second ({film.FPS:g}, or the file's)")
    parser.add_argument(
        "--width", type=positive(int), metavar="PX",
        help=f"width of the pictures (default: that of the HR camera, of a video at most {_LONGEST})",
    )  # fmt: skip
    parser.add_argument("--depth", action="store_true", help="depth as well, in colours with a legend")
    parser.add_argument("--images", action="store_true", help="every frame as PNG, too")
    parser.add_argument("--no-gif", action="store_true", help="only the MP4")
    parser.add_argument("--no-detail", action="store_true", help="without f_det, as LR renders are")
    parser.add_argument("--no-filter", action="store_true", help="without the 3D filter of Mip-Splatting")
    parser.add_argument("--no-mip", action="store_true", help="with 3DGS's blur in place of Mip-Splatting's 2D filter")
    parser.add_argument("--no-sh", action="store_true", help="with colours that do not depend on the direction")
    return parser


def _cameras(splat: SavedSplat, options: argparse.Namespace) -> tuple[list[str], list[Camera], float]:
    """Names, cameras and frames per second of what `--path` names."""
    path, fps = str(options.path), None
    if path in _STILLS:
        chosen = [saved for saved in splat.cameras if saved.split == path]
        if not chosen:
            raise SettingError(f"--path {path}: {splat.folder} has no {path} cameras. Try --path cameras.")
        names = [Path(saved.name).with_suffix("").as_posix().replace("/", "_") for saved in chosen]
        found = [saved.camera for saved in chosen]
    else:
        found, fps = _of_path(splat, path, options.frames)
        names = [f"{i:04d}" for i in range(len(found))]
    if options.width is not None:
        found = [cameras.resized(c, options.width, max(1, round(c.height * options.width / c.width))) for c in found]
    if path not in _STILLS:
        found = [cameras.at_most(c, None if options.width is not None else _LONGEST) for c in found]
        if len({(c.width, c.height) for c in found}) > 1:
            found = [cameras.resized(c, found[0].width, found[0].height) for c in found]
            _log.warning("the cameras have different sizes; all frames have the first one's.")
    return names, found, float(options.fps or fps or film.FPS)


def _of_path(splat: SavedSplat, path: str, frames: int) -> tuple[list[Camera], float | None]:
    poses = splat.poses()
    if path in ("cameras", "ellipse"):
        if not splat.cameras:
            _log.warning("no cameras.json lies with %s: the path sways in front of the splat.", splat.folder)
        return (paths.through if path == "cameras" else paths.ellipse)(poses, frames), None
    if not Path(path).is_file():
        raise SettingError(f"--path: must be cameras, ellipse, train, test or a file of cameras, got {path}.")
    return cameras.read_path(Path(path), (poses[0].width, poses[0].height))
