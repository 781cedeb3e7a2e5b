"""`clear-strategies render RUN`: pictures and videos of a saved run, or of any PLY file, along a camera path."""

from __future__ import annotations

import argparse
import collections
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from clear_strategies import console
from clear_strategies.commands.options import LONGEST, STILLS, parser_of, positive
from clear_strategies.viewing import FPS

_log = logging.getLogger(__name__)

_FRAMES: Final = 120


def main(arguments: Sequence[str]) -> None:
    """Render what the arguments ask for."""
    options = _parser().parse_args(arguments)
    console.show(verbose=options.verbose)
    from clear_strategies.commands.path_cameras import cameras_of
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
    written: list[Path] = []
    kinds = {"": film.color_frames, **({"depth": film.depth_frames} if options.depth else {})}
    for kind, drawn in kinds.items():
        frames = drawn(splat.painter, where, look)
        if options.images or options.path in STILLS:
            pictures = [out / kind / f"{name}.png" for name in names]
            frames = film.saving(frames, pictures)
            written += pictures
        if options.path in STILLS:
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
    parser.add_argument("--fps", type=positive(float), help=f"frames per second ({FPS:g}, or the file's)")
    parser.add_argument(
        "--width", type=positive(int), metavar="PX",
        help=f"width of the pictures (default: that of the HR camera, of a video at most {LONGEST})",
    )  # fmt: skip
    parser.add_argument("--depth", action="store_true", help="depth as well, in colours with a legend")
    parser.add_argument("--images", action="store_true", help="every frame as PNG, too")
    parser.add_argument("--no-gif", action="store_true", help="only the MP4")
    parser.add_argument("--no-detail", action="store_true", help="without f_det, as LR renders are")
    parser.add_argument("--no-filter", action="store_true", help="without the 3D filter of Mip-Splatting")
    parser.add_argument("--no-mip", action="store_true", help="with 3DGS's blur in place of Mip-Splatting's 2D filter")
    parser.add_argument("--no-sh", action="store_true", help="with colours that do not depend on the direction")
    return parser
