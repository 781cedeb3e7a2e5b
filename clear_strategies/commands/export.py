"""`clear-strategies export RUN`: write a saved run as a PLY file for viewers; splat-transform converts it to other formats."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from clear_strategies import console
from clear_strategies.commands import parser_of, path_of
from clear_strategies.errors import SettingError

_log = logging.getLogger(__name__)


def main(arguments: Sequence[str]) -> None:
    parser = parser_of("export", "Write a saved run in the standard layout of 3DGS; f_det and the 3D filter included.")
    parser.add_argument("--out", type=path_of, metavar="FILE", help="where it goes (default: RUN/NAME.ply)")
    kept = "degree of view-dependent colour that is kept (3)"
    parser.add_argument("--sh", type=int, choices=range(4), default=3, metavar="0..3", help=kept)
    options = parser.parse_args(arguments)
    console.show(verbose=options.verbose)
    from clear_strategies.jobs.saved import open_splat
    from clear_strategies.outputs.results import export_ply

    splat = open_splat(options.run, options.rasterizer)
    out = options.out or splat.folder / f"{splat.name}.ply"
    if out.suffix != ".ply":
        raise SettingError(
            f"--out: must end in .ply, got {out.name}. splat-transform makes other formats of a PLY file."
        )
    if out.exists() and out.samefile(options.run):
        raise SettingError(f"--out: must be another file than the one that is read, got {out}.")
    export_ply(out, splat.painter.field, antialiased=splat.antialiased, degree=options.sh)
    _log.info("%s: %s Gaussians, %.1f MB", out, f"{len(splat.painter.field):,}", out.stat().st_size / 1e6)
