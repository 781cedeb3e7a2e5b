"""A splat in a tenth of its size: .spz (Niantic's version 4) and .sog (PlayCanvas's version 2), by the library gaussforge."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch

from clear_strategies.data.ply import GaussianPly, write_gaussians
from clear_strategies.errors import SettingError
from rasterizers.geometry import spherical_harmonics

PACKED: Final = ("spz", "sog")
_SPZ_VERSION: Final = 4
_SOMEWHERE: Final = (1.0, 2.0, 4.0)  # a direction in which no spherical harmonic is 0


def packed_bytes(g: GaussianPly, form: str) -> bytes:
    """The file.

    Args:
        form: one of `PACKED`.

    Raises:
        SettingError: gaussforge is not installed, or refuses the splat.
    """
    try:
        import gaussforge
    except ImportError as error:
        remedy = "pip install 'clear-strategies[export]', or choose --to ply, --to glb or --to splat"
        raise SettingError(f"--to {form} needs gaussforge, which is not installed: {remedy}.") from error
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "splat.ply"
        write_gaussians(source, turned(g) if form == "spz" else g)
        made = gaussforge.GaussForge().convert(source.read_bytes(), "ply", form, spz_version=_SPZ_VERSION)
    if "error" in made:
        raise SettingError(f"--to {form}: gaussforge refuses the splat ({made['error']}). Choose another format.")
    return bytes(made["data"])


def turned(g: GaussianPly) -> GaussianPly:
    """Half a turn around x: y points down in 3DGS files and up in SPZ, and gaussforge leaves the axes as they are."""
    turn = g.means.new_tensor([1.0, -1.0, -1.0])
    direction = torch.nn.functional.normalize(g.means.new_tensor([_SOMEWHERE]), dim=1)
    bands = g.shN.shape[1]
    signs = (spherical_harmonics(direction * turn, bands) / spherical_harmonics(direction, bands))[0, 1:].round()
    return replace(
        g, means=g.means * turn, quats=g.quats * g.quats.new_tensor([1.0, 1.0, -1.0, -1.0]), shN=g.shN * signs[:, None]
    )
