"""Pictures along a list of cameras: of the colours, and of the depth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.images import to_bytes
from clear_strategies.data.photo_files import write_png
from clear_strategies.viewing.look import AS_MEASURED, Look, Painter
from clear_strategies.viewing.video import Pixels
from rasterizers.interface import Camera

_SAMPLED: Final = 5  # cameras that the range of depths is taken from, about
_EXTREMES: Final = (0.02, 0.98)  # quantiles of depth at the ends of the range
COLORS: Final = "viridis_r"
"""matplotlib's name of the colours of depth: near is bright."""
_UNKNOWN: Final = 0.8  # grey


@dataclass(frozen=True, slots=True)
class DepthScale:
    """The range of depths that the colours span, world units."""

    near: float
    far: float

    @classmethod
    def of(cls, painter: Painter, cameras: Sequence[Camera], look: Look = AS_MEASURED) -> DepthScale:
        """From the depths that a few of the cameras see."""
        sampled = cameras[:: math.ceil(len(cameras) / _SAMPLED)]
        return cls.spanning(torch.cat([painter.depth(camera, look).flatten() for camera in sampled]))

    @classmethod
    def spanning(cls, depth: Float[Tensor, "*shape"]) -> DepthScale:
        """From depths; those that are not finite are left out. 0 to 1 where none is finite."""
        known = depth[depth.isfinite()].cpu().numpy()  # torch's own quantile takes 16 million numbers at most
        if not len(known):
            return cls(0.0, 1.0)
        near, far = (float(np.quantile(known, q)) for q in _EXTREMES)
        return cls(near, max(far, near * (1 + 1e-6) + 1e-6))

    def picture(self, depth: Float[Tensor, "H W"]) -> Pixels:
        """Depth in colours, grey where there is none."""
        from matplotlib import colormaps

        values = ((depth - self.near) / (self.far - self.near)).clamp(0, 1).numpy()
        colored = colormaps[COLORS](np.nan_to_num(values))[..., :3]
        colored[~np.isfinite(values)] = _UNKNOWN
        return np.asarray((colored * 255).round().astype(np.uint8))


def color_frames(painter: Painter, cameras: Sequence[Camera], look: Look = AS_MEASURED) -> Iterator[Pixels]:
    """The colours from each camera, 8 bits."""
    return (to_bytes(painter.color(camera, look)) for camera in cameras)


def saving(frames: Iterable[Pixels], paths: Iterable[Path]) -> Iterator[Pixels]:
    """Yield the frames, and write each as a PNG."""
    for frame, path in zip(frames, paths, strict=True):
        write_png(path, torch.from_numpy(frame) / 255)
        yield frame
