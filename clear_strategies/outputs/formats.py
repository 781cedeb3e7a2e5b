"""A splat in the formats of viewers; gaussforge writes .spz (Niantic's version 4) and .sog (PlayCanvas's version 2)."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch

from clear_strategies import files
from clear_strategies.data.ply import GaussianPly, write_gaussians
from clear_strategies.errors import SettingError
from clear_strategies.training.field import GaussianField
from rasterizers.geometry import SH_C0, spherical_harmonics

_SPZ_VERSION: Final = 4
_DIRECTION: Final = (1.0, 2.0, 4.0)  # in which no spherical harmonic is 0


def write_format(path: Path, g: GaussianPly, form: str) -> None:
    """Write the Gaussians as ply, spz or sog, atomically.

    Raises:
        SettingError: gaussforge is not installed, or refuses the splat.
    """
    if form == "ply":
        write_gaussians(path, g)
    else:
        files.write_bytes(path, _packed_bytes(g, form))


def export_ply(path: Path, field: GaussianField, *, antialiased: bool = True) -> None:
    """Write the standard 3DGS layout; f_det is folded into the colour, the 3D filter into scales and opacities.

    Args:
        antialiased: the field was trained with opacity compensation. The header then says `SplatRenderMode: mip`, and a viewer
            that honours this draws the file in the same way.
    """
    write_gaussians(path, gaussians_of(field, antialiased=antialiased))


def gaussians_of(field: GaussianField, *, antialiased: bool) -> GaussianPly:
    """The Gaussians of `export_ply`."""
    splats = field.baked()
    tiny = torch.finfo(torch.float32).eps
    offset = splats.rgb_offset if splats.rgb_offset is not None else torch.zeros_like(splats.means)
    higher = torch.zeros_like(field.shN.data)
    higher[:, : splats.shN.shape[1]] = splats.shN  # bands above the active degree were never rendered
    return GaussianPly(
        means=splats.means,
        sh0=splats.sh0 + offset[:, None] / SH_C0,
        shN=higher,
        opacities=torch.logit(splats.opacities.clamp(tiny, 1 - tiny)),
        scales=splats.scales.log(),
        quats=torch.nn.functional.normalize(splats.quats, dim=-1),
        antialiased=antialiased,
    )


def _packed_bytes(g: GaussianPly, form: str) -> bytes:
    """The .spz or .sog file, by gaussforge."""
    try:
        import gaussforge
    except ImportError as error:
        remedy = "pip install 'clear-strategies[export]', or choose --to ply"
        raise SettingError(f"--to {form} needs gaussforge, which is not installed: {remedy}.") from error
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "splat.ply"
        write_gaussians(source, turned(g) if form == "spz" else g)
        converted = gaussforge.GaussForge().convert(source.read_bytes(), "ply", form, spz_version=_SPZ_VERSION)
    if "error" in converted:
        raise SettingError(f"--to {form}: gaussforge refuses the splat ({converted['error']}). Choose another format.")
    return bytes(converted["data"])


def turned(g: GaussianPly) -> GaussianPly:
    """Half a turn around x: y points down in 3DGS files and up in SPZ, and gaussforge leaves the axes as they are."""
    turn = g.means.new_tensor([1.0, -1.0, -1.0])
    direction = torch.nn.functional.normalize(g.means.new_tensor([_DIRECTION]), dim=1)
    bands = g.shN.shape[1]
    signs = (spherical_harmonics(direction * turn, bands) / spherical_harmonics(direction, bands))[0, 1:].round()
    return replace(
        g, means=g.means * turn, quats=g.quats * g.quats.new_tensor([1.0, 1.0, -1.0, -1.0]), shN=g.shN * signs[:, None]
    )
