"""The folder of a small run as it was saved, without training: Gaussians with detail, view-dependent colour and a 3D filter."""

from pathlib import Path

import torch

from clear_strategies import GCO
from clear_strategies.outputs.results import export_ply
from clear_strategies.training import checkpoint
from clear_strategies.training.field import GaussianField
from clear_strategies.viewing.cameras import write_cameras
from tests.helpers import toy

SCENE = toy.scene()


def write(folder: Path) -> GaussianField:
    """Write checkpoint, cameras and PLY; returns the field."""
    state = toy.started(GCO(), of=SCENE, iterations=3, max_degree=3)
    g = torch.Generator().manual_seed(3)
    for name, amount in (("detail", 0.2), ("shN", 0.3)):
        value = getattr(state.field, name)
        value.data = torch.randn(value.shape, generator=g) * amount
    state.field.opacities.data += 3.0
    state.field.scales.data -= 2.0  # small enough for the filters to matter
    state.field.filter_3d = state.field.filter_3d + 0.1
    state.field.degree = 2
    checkpoint.save(folder / "checkpoints", state.checkpoint({"rasterizer.name": "torch", "rasterizer.kernel": 0.1}))
    write_cameras(folder, SCENE)
    export_ply(folder / "point_cloud.ply", state.field)
    return state.field
