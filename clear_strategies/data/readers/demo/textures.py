"""Photographs of scikit-image as mipmaps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from clear_strategies.errors import DataError

Array = np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """A mipmap: an image and its halvings (area means), one after the other in one table."""

    texels: Float[Array, "T C"]
    starts: Int[Array, " L"]
    widths: Int[Array, " L"]
    heights: Int[Array, " L"]

    @staticmethod
    def of(image: Float[Array, "H W C"], levels: int | None = None) -> Texture:
        pyramid = [image]
        while min(pyramid[-1].shape[:2]) > 4 and len(pyramid) != levels:
            fine = pyramid[-1][: pyramid[-1].shape[0] // 2 * 2, : pyramid[-1].shape[1] // 2 * 2]
            pyramid.append((fine[0::2, 0::2] + fine[1::2, 0::2] + fine[0::2, 1::2] + fine[1::2, 1::2]) / 4)
        heights, widths = np.array([level.shape[:2] for level in pyramid]).T
        texels = np.concatenate([level.reshape(-1, image.shape[2]) for level in pyramid]).astype(np.float32)
        return Texture(texels, np.concatenate(([0], np.cumsum(heights * widths)[:-1])), widths, heights)

    @property
    def aspect(self) -> float:
        return float(self.widths[0] / self.heights[0])

    def sample(self, at: Float[Array, "n 2"], footprint: Float[Array, " n"]) -> Float[Array, "n C"]:
        """Bilinear, in the level whose texels are about as large as the ray spacing (`footprint`, texels of level 0)."""
        level = np.log2(np.maximum(footprint, 1)).round().astype(int).clip(0, len(self.widths) - 1)
        start, width, height = self.starts[level], self.widths[level], self.heights[level]
        folded = np.abs(at - 2 * np.round(at / 2))  # mirrored at every whole number
        x, y = folded.T * np.stack((width, height)).astype(np.float32) - np.float32(0.5)
        left, top = np.floor(x).astype(int), np.floor(y).astype(int)
        fx, fy = (x - left)[:, None], (y - top)[:, None]
        x0, x1 = np.maximum(left, 0), np.minimum(left + 1, width - 1)
        y0, y1 = start + np.maximum(top, 0) * width, start + np.minimum(top + 1, height - 1) * width
        upper = self.texels.take(y0 + x0, 0) * (1 - fx) + self.texels.take(y0 + x1, 0) * fx
        lower = self.texels.take(y1 + x0, 0) * (1 - fx) + self.texels.take(y1 + x1, 0) * fx
        return np.asarray(upper * (1 - fy) + lower * fy)


@cache
def photograph(name: str) -> Texture:
    """A photograph that scikit-image ships, RGB in [0, 1]."""
    import skimage

    folder = Path(skimage.__file__).parent / "data"
    path = next((p for suffix in (".png", ".jpg") if (p := folder / f"{name}{suffix}").exists()), None)
    if path is None:
        remedy = "install scikit-image 0.24 to 0.26, or train on data of your own"
        raise DataError(folder, name, "is not among the photographs of this scikit-image", remedy)
    with Image.open(path) as photo:
        return Texture.of(np.asarray(photo.convert("RGB"), np.float32) / 255)
