"""A splat in the formats of viewers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from clear_strategies import files
from clear_strategies.data.ply import GaussianPly, write_gaussians
from clear_strategies.errors import SettingError
from clear_strategies.outputs.format_names import FORMATS
from clear_strategies.outputs.gltf import glb_bytes
from clear_strategies.outputs.packed import packed_bytes
from clear_strategies.training.field import GaussianField
from rasterizers.geometry import SH_C0


def write_format(path: Path, g: GaussianPly, form: str) -> None:
    """Write the Gaussians as one of `FORMATS`, atomically.

    Raises:
        SettingError: there is no such format, or what it needs is not installed.
    """
    if form not in FORMATS:
        raise SettingError(f"--to must be one of {', '.join(FORMATS)}, got {form}.")
    if form == "ply":
        write_gaussians(path, g)
    elif form == "splat":
        files.write_bytes(path, splat_bytes(g))
    elif form == "glb":
        files.write_bytes(path, glb_bytes(g))
    else:
        files.write_bytes(path, packed_bytes(g, form))


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


def splat_bytes(g: GaussianPly) -> bytes:
    """The .splat file: position and scales as float32, RGBA and quaternion as bytes; the most visible Gaussians first."""
    alpha = g.opacities.sigmoid()
    order = (alpha.log() + g.scales.sum(1)).argsort(descending=True, stable=True)
    rgba = torch.cat([g.sh0[:, 0] * SH_C0 + 0.5, alpha[:, None]], dim=1)
    quats = torch.nn.functional.normalize(g.quats, dim=1)
    table = np.zeros(len(g), [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
    for name, values in (
        ("means", g.means),
        ("scales", g.scales.exp()),
        ("rgba", (rgba.clamp(0, 1) * 255).round()),
        ("quats", (quats * 128 + 128).round().clamp(0, 255)),
    ):
        table[name] = values[order].cpu().numpy()
    return table.tobytes()
