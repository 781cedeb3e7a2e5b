"""The demo, the default data set: a procedural room, which needs no download.

It holds pictures, boxes and balls at several depths, textured with photographs that scikit-image ships inside its wheel,
and is ray-cast with anti-aliasing from exact poses. The capture brings its own prior, `priors.DemoPrior`, which is synthetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import require_whole
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.priors.corrupted import DemoPrior
from clear_strategies.errors import DataError, SettingError
from rasterizers.interface import Camera

_RAYS: Final = 4  # per pixel and axis
_BAND: Final = 16  # image rows cast at once, few enough for the CPU's caches
_FIELD_OF_VIEW: Final = math.radians(58)
_ARC: Final = 0.75  # the cameras' largest offset to the left and right, world units
_TARGET: Final = np.array([0.0, 0.15, 5.0])
Array = np.ndarray
Vector = tuple[float, float, float]
_FLOOR: Final = 1.35  # y; y points down
_WALL: Final = 7.5  # z
LAMP: Final = np.array([-4.0, -2.9, 1.2])
_LAMP_SIZE: Final = 0.9  # edge of the square lamp; an extended lamp has soft shadows
_LAMP_REACH: Final = 8.5  # distance at which its light is halved
_AMBIENT: Final = 0.3
_EXPOSURE: Final = 1.9
_LIGHT_TEXEL: Final = 0.08  # of the baked light, world units
_PREPARING: Final = Lock()


def read(*, width: int = 256, height: int = 192, views: int = 12, train: int = 3) -> Capture:
    """The room from cameras on an arc.

    Args:
        width, height: of the HR images.
        views: how many cameras there are.
        train: how many of them, evenly spaced, are for training, at least 2; the others are for testing.

    Raises:
        SettingError: a number is outside its range.
    """
    for name, value in (("width", width), ("height", height), ("views", views), ("train", train)):
        require_whole(f"data.reader.{name}", value, least=1)
    if not 2 <= train < views:
        raise SettingError(
            f"data.reader.train: 2 <= train < views must hold, got train={train}, views={views}: lower data.reader.train"
        )
    chosen = {round((i + 0.5) * views / train - 0.5) for i in range(train)}
    frames = []
    for i in range(views):
        camera = _camera(2 * i / (views - 1) - 1, width, height)
        load = lru_cache(maxsize=1)(partial(render, camera))
        frames.append(Frame(f"demo_{i:02d}", camera, load, split="train" if i in chosen else "test"))
    notes = {"poses": "exact", "scene": "procedural room, photographs from scikit-image"}
    return Capture("demo", tuple(frames), notes=notes, own_prior=DemoPrior)


def render(camera: Camera) -> Float[Tensor, "H W 3"]:
    """Ray-cast with 4 × 4 rays a pixel and prefiltered textures; 8-bit values, as a photo would have."""
    with _PREPARING:  # of threads that read the photos at once, one makes what all need
        for surface in room():
            photograph(surface.finish.texture)
            light_on(surface)
    bands = []
    for first in range(0, camera.height, _BAND):
        rays = Rays.through(camera, first, min(first + _BAND, camera.height), _RAYS)
        colors = _cast(rays).reshape(-1, _RAYS, camera.width, _RAYS, 3)
        bands.append(colors.mean(axis=(1, 3)))
    return images.quantize(torch.from_numpy(np.concatenate(bands)).clamp(0, 1))


def _camera(position: float, width: int, height: int) -> Camera:
    """On the arc, `position` in [-1, 1] from left to right, looking at the middle of the room."""
    center = np.array([_ARC * position, -0.15 + 0.12 * math.cos(2.2 * position), 0.35 * position**2])
    forward = unit(_TARGET - center)
    right = unit(np.cross([0.0, 1.0, 0.0], forward))
    rotation = np.stack((right, np.cross(forward, right), forward))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    focal = width / (2 * math.tan(_FIELD_OF_VIEW / 2))
    return Camera(torch.from_numpy(pose), focal, focal, width / 2, height / 2, width, height)


def _cast(rays: Rays) -> Float[Array, "h w 3"]:
    """The colour of the nearest surface along each ray; black where there is none."""
    nearest = np.full((rays.y.size, rays.x.size), np.inf, np.float32)
    owner = np.full(nearest.shape, -1, np.int8)
    for k, surface in enumerate(room()):
        distance = surface.depth(rays)
        owner[distance < nearest] = k
        np.minimum(nearest, distance, out=nearest)
    colors = np.zeros((nearest.size, 3), np.float32)
    for k, surface in enumerate(room()):
        mine = np.flatnonzero(owner == k)
        if mine.size:
            distance, directions = nearest.ravel()[mine], rays.directions(mine)
            points = f32(rays.origin) + distance[:, None] * directions
            colors[mine] = _color(surface, points, directions, distance * rays.spacing)
    return colors.reshape(*nearest.shape, 3)


def _color(
    surface: Surface, points: Float[Array, "n 3"], directions: Float[Array, "n 3"], spacing: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Photograph × light, plus the lamp's reflection on a glossy surface. `spacing`: of the rays, world units."""
    finish, chart = surface.finish, surface.chart(points)
    picture = photograph(finish.texture)
    at = chart * f32(finish.repeat) + f32(finish.shift)
    albedo = picture.sample(at, spacing * (finish.repeat[0] * float(picture.widths[0]) / surface.extent[0]))
    light = light_on(surface).sample(chart, np.ones_like(spacing))
    color = albedo * (f32(finish.tint) * light)
    if finish.gloss:
        half = unit(unit(LAMP - points) - unit(directions))
        color += finish.gloss * np.maximum((half * surface.normal(points)).sum(-1, keepdims=True), 0) ** 40
    return np.asarray(color, np.float32)


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
        """Of the rays with these indices into the grid, counted row by row."""
        right, down, forward = f32(self.axes)
        row, column = np.divmod(which, self.x.size)
        return np.asarray(self.x[0, column, None] * right + (self.y * down + forward)[row])


@dataclass(frozen=True, slots=True)
class Finish:
    """How a surface looks."""

    texture: str  # a photograph of scikit-image
    tint: Vector = (1.0, 1.0, 1.0)
    repeat: tuple[float, float] = (1.0, 1.0)  # on the surface's chart, every second one mirrored: there is no seam
    shift: tuple[float, float] = (0.0, 0.0)
    gloss: float = 0.0  # strength of the lamp's reflection


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle: its centre, and half its sides as vectors.

    Its normal, down × right, has unit length and points outside. Its chart, which `points` inverts, are coordinates in [0, 1]²
    for its texture and its light.
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
        """Along each ray; infinite if the ray misses the shape."""
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
        """Whether the shape is between the points and the lamp."""
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
    """A sphere, as a `Panel` in all that it answers. Its chart is longitude and latitude."""

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
    """In single precision: rays are cast twice as fast, and the error is far below a texel."""
    return np.asarray(values, np.float32)


@cache
def room() -> tuple[Surface, ...]:
    """A yard: pictures on the wall and leaning before it, a box, and balls on the ground."""
    brick = Finish("brick", (1.12, 0.80, 0.66), repeat=(2.0, 3.0), shift=(0.1, 0.35))
    gravel = Finish("gravel", (0.78, 0.74, 0.68), repeat=(4.0, 3.0))
    # On a ball, repeat (2, 1) shows the whole photograph from the front; smaller values enlarge its middle.
    marble = Finish("ihc", repeat=(2.0, 1.0), shift=(-0.5, 0.0), gloss=0.3)
    moss = Finish("grass", (0.62, 0.95, 0.42), repeat=(2.0, 1.0), shift=(-0.5, 0.0))
    retina = Finish("retina", (1.1, 1.1, 1.1), repeat=(1.2, 0.6), shift=(-0.1, 0.2), gloss=0.35)
    rainbow = Finish("color", (1.1, 1.1, 1.1), repeat=(1.2, 0.6), shift=(-0.1, 0.2), gloss=0.35)
    return (
        # The photograph shows the courses of bricks vertically; the panel is turned by a right angle.
        Panel(brick, center=(0.0, -1.2, _WALL), right=(0.0, -4.2, 0.0), down=(7.0, 0.0, 0.0)),
        Panel(gravel, center=(0.0, _FLOOR, 3.75), right=(7.0, 0.0, 0.0), down=(0.0, 0.0, -4.75)),
        *_hung("rocket", x=-1.75, y=-1.05, width=2.1),
        *_hung("motorcycle_left", x=0.75, y=-0.95, width=1.6),
        *_hung("hubble_deep_field", x=2.7, y=-1.1, width=1.35),
        _leaning("astronaut", x=-1.95, z=5.6, width=1.7, turn=0.42),
        _leaning("chelsea", x=1.8, z=5.1, width=2.0, turn=-0.45),
        *_box("coffee", x=-0.1, z=5.0, size=(0.96, 0.64, 0.64), turn=0.5),
        Ball(rainbow, (-0.1, _FLOOR - 0.64 - 0.27, 5.0), 0.27),
        Ball(marble, (-1.05, _FLOOR - 0.42, 4.15), 0.42),
        Ball(retina, (0.75, _FLOOR - 0.33, 3.95), 0.33),
        Ball(moss, (-0.3, _FLOOR - 0.2, 3.7), 0.2),
    )


def _hung(texture: str, *, x: float, y: float, width: float) -> tuple[Panel, Panel]:
    """A framed picture on the wall."""
    half, frame = width / 2, 0.07
    tall = half / photograph(texture).aspect
    wood = Finish("coffee", (0.55, 0.42, 0.32), repeat=(0.1, 0.1), shift=(0.02, 0.02))
    return (
        Panel(wood, (x, y, _WALL - 0.05), (half + frame, 0.0, 0.0), (0.0, tall + frame, 0.0)),
        Panel(Finish(texture), (x, y, _WALL - 0.06), (half, 0.0, 0.0), (0.0, tall, 0.0)),
    )


def _leaning(texture: str, *, x: float, z: float, width: float, turn: float, lean: float = 0.16) -> Panel:
    """A picture on the ground, turned about the vertical and leaning back; angles in radians."""
    half = width / 2
    tall = half / photograph(texture).aspect
    right, back = _turned(turn)
    down = tall * (math.cos(lean) * np.array([0, 1, 0]) - math.sin(lean) * back)
    center = np.array([x, _FLOOR, z]) - down
    return Panel(Finish(texture), tuple(center), tuple(half * right), tuple(down))


def _box(texture: str, *, x: float, z: float, size: Vector, turn: float) -> tuple[Panel, ...]:
    """The five visible faces of a box on the ground; `size`: width, height, length."""
    right, back = (side * length / 2 for side, length in zip(_turned(turn), size[::2], strict=True))
    down, finish = np.array([0, size[1] / 2, 0]), Finish(texture)
    center = np.array([x, _FLOOR - size[1] / 2, z])
    faces = (
        (-back, right, down),
        (right, back, down),
        (-right, -back, down),
        (back, -right, down),
        (-down, right, -back),
    )
    return tuple(Panel(finish, tuple(center + out), tuple(across), tuple(along)) for out, across, along in faces)


def _turned(angle: float) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
    """Right and back after a turn about the vertical, radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c, 0, s]), np.array([-s, 0, c])


@cache
def light_on(surface: Surface) -> Texture:
    """The light of the lamp and the sky on a surface, with soft shadows. It does not depend on the view, so it is baked."""
    width, height = (max(math.ceil(side / _LIGHT_TEXEL), 4) for side in surface.extent)
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    points = surface.points(np.stack((u.ravel(), v.ravel()), -1))
    normal = surface.normal(points)
    offsets = np.array((-1, 0, 1)) * _LAMP_SIZE / 3
    direct = np.zeros(len(points))
    for dx in offsets:
        for dz in offsets:
            lamp = LAMP + np.array((dx, 0, dz))
            way = lamp - points
            distance = np.linalg.norm(way, axis=-1)
            cosine = np.maximum((way * normal).sum(-1) / distance, 0)
            shadowed = np.any([other.blocks(points, lamp) for other in room() if other is not surface], axis=0)
            direct += np.where(shadowed, 0, cosine) / (1 + (distance / _LAMP_REACH) ** 2) / offsets.size**2
    light = _EXPOSURE * (_AMBIENT * (0.75 - 0.25 * normal[:, 1]) + (1 - _AMBIENT) * direct)
    return Texture.of(light.reshape(height, width, 1), levels=1)
