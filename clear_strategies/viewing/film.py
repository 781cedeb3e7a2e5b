"""Pictures and videos along a list of cameras: in colour, and of the depth with a legend."""

from __future__ import annotations

import io
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
from clear_strategies.viewing.video import Frame
from rasterizers.interface import Camera

_SAMPLED: Final = 5  # pictures that the colours' range is taken from
_EXTREMES: Final = (0.02, 0.98)  # quantiles of depth at the ends of the colours
_COLORS: Final = "viridis_r"
_UNKNOWN: Final = 0.8  # grey
_LEGEND: Final = 40  # px, height of the strip below a picture of depth


@dataclass(frozen=True, slots=True)
class DepthScale:
    """The colours of depth: the nearest and the farthest that they tell apart, world units."""

    near: float
    far: float

    @classmethod
    def of(cls, painter: Painter, cameras: Sequence[Camera], look: Look = AS_MEASURED) -> DepthScale:
        """From a few of the cameras."""
        some = cameras[:: math.ceil(len(cameras) / _SAMPLED)]
        return cls.spanning(torch.cat([painter.depth(camera, look).flatten() for camera in some]))

    @classmethod
    def spanning(cls, depth: Float[Tensor, "*shape"]) -> DepthScale:
        """From depths, of which those that are not finite are unknown; 0 to 1 where none is known."""
        known = depth[depth.isfinite()].cpu().numpy()  # torch's own quantile takes 16 million numbers at most
        if not len(known):
            return cls(0.0, 1.0)
        near, far = (float(np.quantile(known, q)) for q in _EXTREMES)
        return cls(near, max(far, near * (1 + 1e-6) + 1e-6))

    def picture(self, depth: Float[Tensor, "H W"], *, legend: bool = True) -> Frame:
        """Depth in colours, grey where there is none, over a strip that explains them."""
        from matplotlib import colormaps

        values = ((depth - self.near) / (self.far - self.near)).clamp(0, 1).numpy()
        colored = colormaps[_COLORS](np.nan_to_num(values))[..., :3]
        colored[~np.isfinite(values)] = _UNKNOWN
        frame = np.asarray((colored * 255).round().astype(np.uint8))
        return np.concatenate([frame, self.legend(frame.shape[1])]) if legend else frame

    def legend(self, width: int) -> Frame:
        """A strip of `_LEGEND` px with the colours and their numbers."""
        from matplotlib import colormaps, colors
        from matplotlib.cm import ScalarMappable
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width / 100, _LEGEND / 100), dpi=100)
        axis = figure.add_axes((0.05, 0.62, 0.9, 0.28))
        scale = ScalarMappable(colors.Normalize(self.near, self.far), colormaps[_COLORS])
        bar = figure.colorbar(scale, cax=axis, orientation="horizontal")
        label = "depth" if width < 300 else "depth, world units; grey: nothing there"
        bar.set_label(label, fontsize=6.5, labelpad=1)
        bar.ax.tick_params(labelsize=6.5, pad=1, length=2)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="rgba", dpi=100)
        return np.frombuffer(buffer.getvalue(), np.uint8).reshape(_LEGEND, -1, 4)[:, :width, :3].copy()


def color_frames(painter: Painter, cameras: Sequence[Camera], look: Look = AS_MEASURED) -> Iterator[Frame]:
    """The pictures, 8 bits."""
    return (to_bytes(painter.color(camera, look)) for camera in cameras)


def depth_frames(painter: Painter, cameras: Sequence[Camera], look: Look = AS_MEASURED) -> Iterator[Frame]:
    """The depth of each picture, all in the same colours, with the legend below."""
    scale = DepthScale.of(painter, cameras, look)
    legend: dict[int, Frame] = {}
    for camera in cameras:
        frame = scale.picture(painter.depth(camera, look), legend=False)
        width = frame.shape[1]
        if width not in legend:
            legend[width] = scale.legend(width)
        yield np.concatenate([frame, legend[width]])


def saving(frames: Iterable[Frame], paths: Iterable[Path]) -> Iterator[Frame]:
    """The frames, each written as a PNG while it passes."""
    for frame, path in zip(frames, paths, strict=True):
        write_png(path, torch.from_numpy(frame) / 255)
        yield frame
