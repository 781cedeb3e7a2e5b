"""A wall of opaque Gaussians, and cameras before it that look at it."""

import torch

from clear_strategies.training.field import GaussianField
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera
from tests.helpers import planes, toy


def at(x: float) -> Camera:
    """Four units before the wall; sees 4.8 of its width."""
    return planes.camera(x, 60, 40, 50.0)


def painter() -> Painter:
    """Of a wall at z = 4 from x = -6 to x = 6."""
    x, y = torch.meshgrid(torch.arange(-6.0, 6.1, 0.3), torch.arange(-3.0, 3.1, 0.3), indexing="ij")
    means = torch.stack((x, y, torch.full_like(x, 4.0)), dim=-1).reshape(-1, 3)
    count = len(means)
    field = GaussianField(
        {
            "means": means, "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), "scales": torch.full((count, 3), -1.2),
            "opacities": torch.full((count,), 4.0), "sh0": torch.zeros(count, 1, 3), "shN": torch.zeros(count, 0, 3),
            "detail": torch.zeros(count, 3),
        },
        degree=0,
    )  # fmt: skip
    return Painter(field, lambda **settings: toy.RASTERIZER)
