"""`clear-strategies export RUN --to FORMAT`: a saved run as a file for viewers."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from clear_strategies import console
from clear_strategies.commands.options import parser_of
from clear_strategies.errors import SettingError

_log = logging.getLogger(__name__)

_FORMATS: Final = {
    "ply": "the standard layout of 3DGS; nothing is lost",
    "spz": "Niantic's, version 4: a tenth of the PLY, the strong view-dependent colour included",
    "sog": "PlayCanvas's: a fifth of the PLY, view-dependent colour included; slow for large splats",
}


def main(arguments: Sequence[str]) -> None:
    """Write what the arguments ask for."""
    parser = parser_of(
        "export", "Write a saved run, or a PLY file, in a format of viewers; f_det and the 3D filter included."
    )
    parser.add_argument(
        "--to", required=True, choices=_FORMATS, help="; ".join(f"{name}: {what}" for name, what in _FORMATS.items())
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="where it goes (default: RUN/NAME.FORMAT, beside a PLY file)"
    )
    kept = "degree of view-dependent colour that is kept (3)"
    parser.add_argument("--sh", type=int, choices=range(4), default=3, metavar="0..3", help=kept)
    options = parser.parse_args(arguments)
    console.show(verbose=options.verbose)
    from clear_strategies.jobs.saved import open_splat
    from clear_strategies.outputs.formats import gaussians_of, write_format

    splat = open_splat(options.run, options.rasterizer)
    g = gaussians_of(splat.painter.field, antialiased=splat.antialiased)
    g = replace(g, shN=g.shN[:, : (options.sh + 1) ** 2 - 1])
    out = options.out or splat.folder / f"{splat.name}.{options.to}"
    if out.suffix != f".{options.to}":
        raise SettingError(f"--out: must end in .{options.to}, got {out.name}.")
    if out.exists() and out.samefile(options.run):
        raise SettingError(f"--out: must be another file than the one that is read, got {out}.")
    write_format(out, g, options.to)
    _log.info("%s: %s Gaussians, %.1f MB", out, f"{len(g):,}", out.stat().st_size / 1e6)
