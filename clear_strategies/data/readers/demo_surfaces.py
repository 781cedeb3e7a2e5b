"""The surfaces of the demo's room: rectangles and balls textured with photographs, and their intersections with rays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image

from clear_strategies.errors import DataError
from rasterizers.interface import Camera

Array = np.ndarray
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The rays of a pixel grid, origin + t · (x · right + y · down + forward), where t is the depth.

    They are linear in x and y, so their dot product with a fixed vector is the sum of a row and a column. That makes
    intersections with planes and spheres cheap.
    """

    origin: Float[Array, " 3"]
    axes: Float[Array, "3 3"]
    x: Float[Array, "1 w"]
    y: Float[Array, "h 1"]
    spacing: float

    @staticmethod
    def through(camera: Camera, first: int, last: int, per_pixel: int) -> Rays:
        """The rays of the image rows from `first` up to `last`, `per_pixel`² per pixel."""
        x = (np.arange(camera.width * per_pixel) + 0.5) / per_pixel
        y = (np.arange(first * per_pixel, last * per_pixel) + 0.5) / per_pixel
        return Rays(
            camera.center.double().numpy(),
            camera.world_to_camera[:3, :3].double().numpy(),
            ((x - camera.cx) / camera.fx)[None, :].astype(np.float32),
            ((y - camera.cy) / camera.fy)[:, None].astype(np.float32),
            1 / (camera.fx * per_pixel),
        )

    def dot(self, vector: Array) -> Float[Array, "h w"]:
        right, down, forward = f32(self.axes @ vector)
        return np.asarray(self.x * right + (self.y * down + forward))

    def directions(self, which: Int[Array, " n"]) -> Float[Array, "n 3"]:
        """The directions of the rays with these indices into the grid, counted row by row."""
        right, down, forward = f32(self.axes)
        row, column = np.divmod(which, self.x.size)
        return np.asarray(self.x[0, column, None] * right + (self.y * down + forward)[row])


@dataclass(frozen=True, slots=True)
class Finish:
    """The appearance of a surface."""

    texture: str  # a photograph of scikit-image
    tint: Vector = (1.0, 1.0, 1.0)
    repeat: tuple[float, float] = (1.0, 1.0)  # on the surface's chart, every second one mirrored: there is no seam
    shift: tuple[float, float] = (0.0, 0.0)
    gloss: float = 0.0  # strength of the lamp's reflection


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle: its centre, and half its sides as vectors.

    Its normal, down × right, has unit length and points outside. `chart` maps its points to coordinates in [0, 1]² of its texture
    and its light, and `points` is the inverse.
    """

    finish: Finish
    center: Vector
    right: Vector
    down: Vector

    @property
    def extent(self) -> tuple[float, float]:
        """The chart's width and height, world units."""
        return 2 * math.hypot(*self.right), 2 * math.hypot(*self.down)

    def depth(self, rays: Rays) -> Float[Array, "h w"]:
        """The depth along each ray; infinite if the ray misses the shape."""
        offset = rays.origin - np.asarray(self.center)
        right, down = _dual(self.right), _dual(self.down)
        normal = self._normal
        facing = rays.dot(normal)
        # A ray parallel to the plane divides by zero, and misses.
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.float32(-offset @ normal) / facing
            u = np.float32(offset @ right) + t * rays.dot(right)
            v = np.float32(offset @ down) + t * rays.dot(down)
            inside = (t > 0) & (np.abs(u) <= 1) & (np.abs(v) <= 1)
        return np.asarray(np.where(inside, t, np.float32(np.inf)))

    def chart(self, points: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
        basis = np.stack((_dual(self.right), _dual(self.down)), -1)
        return np.asarray((points - f32(self.center)) @ f32(basis) / 2 + np.float32(0.5))

    def points(self, chart: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        return np.asarray(np.asarray(self.center) + (2 * chart - 1) @ np.array((self.right, self.down)))

    def normal(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        return np.broadcast_to(self._normal, points.shape)

    def blocks(self, points: Float[Array, "n 3"], lamp: Float[Array, " 3"]) -> Bool[Array, " n"]:
        """Return True for points that the shape hides from the lamp."""
        normal = self._normal
        here, there = (points - self.center) @ normal, (lamp - self.center) @ normal
        apart = (np.abs(here) > 1e-4) & (here * there < 0)
        s = (here / np.where(apart, here - there, 1))[:, None]
        return np.asarray(apart & (np.abs(2 * self.chart(points + s * (lamp - points)) - 1) <= 1).all(-1))

    @property
    def _normal(self) -> Float[Array, " 3"]:
        return unit(np.cross(self.down, self.right))


@dataclass(frozen=True, slots=True)
class Ball:
    """A sphere, with the methods of `Panel`. Its chart is longitude and latitude."""

    finish: Finish
    center: Vector
    radius: float

    @property
    def extent(self) -> tuple[float, float]:
        return 2 * math.pi * self.radius, math.pi * self.radius

    def depth(self, rays: Rays) -> Float[Array, "h w"]:
        offset = rays.origin - np.asarray(self.center)
        b, square = rays.dot(offset), 1 + rays.x**2 + rays.y**2
        discriminant = b * b - square * np.float32(offset @ offset - self.radius**2)
        t = (-b - np.sqrt(np.maximum(discriminant, 0))) / square
        return np.where((discriminant > 0) & (t > 0), t, np.float32(np.inf))

    def chart(self, points: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
        x, y, z = self.normal(points).T
        longitude, latitude = np.arctan2(x, -z) / (2 * math.pi), np.arccos(np.clip(-y, -1, 1)) / math.pi
        return np.stack((longitude + 0.5, latitude), -1).astype(np.float32)

    def points(self, chart: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        longitude, latitude = 2 * math.pi * (chart[:, 0] - 0.5), math.pi * chart[:, 1]
        ring = np.sin(latitude)
        unit = np.stack((ring * np.sin(longitude), -np.cos(latitude), -ring * np.cos(longitude)), -1)
        return np.asarray(self.center) + self.radius * unit

    def normal(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        return np.asarray((points - np.asarray(self.center, points.dtype)) / self.radius)

    def blocks(self, points: Float[Array, "n 3"], lamp: Float[Array, " 3"]) -> Bool[Array, " n"]:
        way = lamp - points
        s = np.clip(((self.center - points) * way).sum(-1) / (way * way).sum(-1), 0, 1)[:, None]
        return np.asarray(np.linalg.norm(points + s * way - self.center, axis=-1) < self.radius * (1 - 1e-4))


Surface = Panel | Ball


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


def unit(vectors: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _dual(side: Vector) -> Float[Array, " 3"]:
    """The vector whose dot product with `side` is one."""
    return np.asarray(np.asarray(side) / np.dot(side, side))


def f32(values: Array | tuple[float, ...]) -> Float[Array, "*shape"]:
    """Convert to single precision: rays are cast twice as fast, and the error is far below a texel."""
    return np.asarray(values, np.float32)
