"""Views of a textured plane at two scales, with its depth: what different views show can be compared exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.view import DepthMap, Photo, View
from tests.helpers.planes import camera

FACTOR, PATCH, WIDTH, HEIGHT = 4, 8, 48, 32  # LR px; 6 x 4 patches
SHIFT = 2  # LR px between neighbouring cameras: f = 50 px, baseline 0.16, z = 4


def texture(width: int) -> Tensor:
    """Structure at every scale from 1 to 16 HR px, in 8-bit steps."""
    rng, total = np.random.default_rng(0), torch.zeros(HEIGHT * FACTOR, width, 3)
    for size in (1, 2, 4, 8, 16):
        noise = torch.from_numpy(rng.random((1, 3, HEIGHT * FACTOR // size + 2, width // size + 2), dtype=np.float32))
        total += torch.nn.functional.interpolate(noise, size=total.shape[:2], mode="bilinear")[0].permute(1, 2, 0)
    return images.quantize((total - total.min()) / (total.max() - total.min()))


def plane_views(count: int = 3, *, offset: float = 0.0) -> list[View]:
    """The plane at z = 4, its true HR photos as SR images.

    Args:
        offset: relative error of the depth.
    """
    whole, step = texture((WIDTH + SHIFT * count) * FACTOR), SHIFT * FACTOR
    views = []
    for i in range(count):
        hr = whole[:, i * step : i * step + WIDTH * FACTOR].contiguous()
        here = camera(0.16 * i, WIDTH, HEIGHT, 50.0)
        depth = torch.full((HEIGHT, WIDTH), 4.0 * (1 + offset))
        lr = Photo(here, images.downsample(hr, FACTOR))
        views.append(View(f"v{i}", lr, Photo(here.scaled(FACTOR), hr), depth=DepthMap(depth, torch.ones_like(depth))))
    return views


def with_invention(views: list[View], which: int, row: int, column: int) -> list[View]:
    """The same with other detail in one patch of one view, which shrinks to the same LR pixels."""
    edge = PATCH * FACTOR
    box = (slice(row * edge, (row + 1) * edge), slice(column * edge, (column + 1) * edge))
    view = views[which]
    hr = view.hr.image.clone()
    detail = hr - images.upsample(images.downsample(hr, FACTOR), FACTOR)
    hr[box] = (hr - detail + detail.flip(0, 1))[box]
    touched = torch.zeros_like(hr[..., :1])
    touched[box] = 1
    hr = images.quantize(images.back_projected(hr, view.lr.image, FACTOR, 20, where=touched))
    return [*views[:which], replace(view, hr=Photo(view.hr.camera, hr)), *views[which + 1 :]]
