"""point_cloud.ply: the trained field for any viewer of 3DGS files, looking as it was evaluated."""

from __future__ import annotations

from pathlib import Path

import torch

from clear_strategies.data.ply import GaussianPly, write_gaussians
from clear_strategies.training.field import GaussianField
from rasterizers.geometry import SH_C0


def export_ply(path: Path, field: GaussianField) -> None:
    """Write the standard 3DGS layout; f_det is folded into the colour, the 3D filter into scales and opacities.

    A viewer that honours the header's `SplatRenderMode: mip` draws the file with opacity compensation, as in training.
    """
    write_gaussians(path, gaussians_of(field))


def gaussians_of(field: GaussianField) -> GaussianPly:
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
    )
