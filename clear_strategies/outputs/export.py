"""A field as a PLY file in the standard layout of 3DGS, for viewers and other programs."""

from __future__ import annotations

from pathlib import Path

import torch

from clear_strategies.data.ply import GaussianPly, write_gaussians
from clear_strategies.training.field import GaussianField
from rasterizers.geometry import SH_C0


def export_ply(path: Path, field: GaussianField, *, antialiased: bool = True, degree: int = 3) -> None:
    """Write the field, atomically; f_det is folded into the colour, the 3D filter into scales and opacities.

    Args:
        antialiased: the field was trained with opacity compensation. The header then says `SplatRenderMode: mip`, and a viewer
            that honours this draws the file in the same way.
        degree: of view-dependent colour that is kept, at most that of the field.
    """
    splats = field.baked()
    tiny = torch.finfo(torch.float32).eps
    offset = splats.rgb_offset if splats.rgb_offset is not None else torch.zeros_like(splats.means)
    higher = torch.zeros_like(field.shN.data)
    higher[:, : splats.shN.shape[1]] = splats.shN  # bands above the active degree were never rendered
    gaussians = GaussianPly(
        means=splats.means,
        sh0=splats.sh0 + offset[:, None] / SH_C0,
        shN=higher[:, : (degree + 1) ** 2 - 1],
        opacities=torch.logit(splats.opacities.clamp(tiny, 1 - tiny)),
        scales=splats.scales.log(),
        quats=torch.nn.functional.normalize(splats.quats, dim=-1),
        antialiased=antialiased,
    )
    write_gaussians(path, gaussians)
