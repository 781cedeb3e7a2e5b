"""The embedded default: a procedural room, so that a bare machine runs the main job with nothing else.

Planes and spheres at several depths, textured with photographs that scikit-image ships inside its wheel, ray-cast with
anti-aliasing from exact poses. Its prior is the truth with seeded errors that differ from view to view, so that
reliability means something; every report calls it synthetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from clear_strategies import images
from clear_strategies.data.capture import Capture, Frame
from rasterizers.interface import Camera

Array = np.ndarray

_SUPERSAMPLING: Final = 4  # rays per pixel and axis
_FIELD_OF_VIEW: Final = math.radians(58)
_ARC: Final = 0.75  # the cameras' way to the left and right, world units
_TARGET: Final = np.array([0.0, 0.15, 5.0])
_LIGHT: Final = np.array([-0.45, -0.8, -0.6]) / np.linalg.norm([-0.45, -0.8, -0.6])
_AMBIENT: Final = 0.45


def read(*, width: int = 256, height: int = 192, views: int = 12, train: int = 3) -> Capture:
    """The room, seen from an arc; `train` views spread over it are for training, the others for testing.

    Args:
        width, height: of the HR images, px.

    Raises:
        ValueError: fewer views than training views, or fewer than two of those.
    """
    if not 2 <= train < views:
        raise ValueError(f"2 <= train < views must hold, got train={train}, views={views}.")
    chosen = {round((i + 0.5) * views / train - 0.5) for i in range(train)}
    frames = []
    for i in range(views):
        camera = _camera(2 * i / (views - 1) - 1, width, height)
        load = lru_cache(maxsize=1)(partial(render, camera))
        frames.append(Frame(f"demo_{i:02d}", camera, load, split="train" if i in chosen else "test"))
    return Capture(
        "demo",
        tuple(frames),
        notes={"poses": "exact", "scene": "procedural room, photographs from scikit-image"},
    )


@dataclass(frozen=True, slots=True, eq=False)
class DemoPrior:
    """Ground-truth detail with seeded errors that differ from view to view.

    In a `share` of the patches the detail is replaced: turned over (agrees with LR, fights the other views), sharpened
    into ringing, or shifted in brightness (disagrees with LR, which reliability can see).

    Args:
        truth: HR image of each view by name. share: of patches with errors, in [0, 1]. strength: of the errors, >= 0.
        patch: edge of a patch, HR px.
    """

    truth: Mapping[str, Callable[[], Float[Tensor, "H W 3"]]]
    share: float = 0.3
    strength: float = 1.0
    patch: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ValueError(f"share must lie in [0, 1], got {self.share}.")
        if self.strength < 0 or self.patch < 1:
            raise ValueError(f"strength must be >= 0 and patch >= 1, got {self.strength} and {self.patch}.")

    @property
    def label(self) -> str:
        return f"demo (synthetic: truth with seeded errors in {self.share:.0%} of the patches)"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        truth = self.truth[name]()
        low = images.upsample(lr, factor)
        detail = truth - low
        rng = np.random.default_rng([self.seed, *name.encode()])
        result = truth.clone()
        for top in range(0, truth.shape[0], self.patch):
            for left in range(0, truth.shape[1], self.patch):
                box = (slice(top, top + self.patch), slice(left, left + self.patch))
                kind, wrong, shade = rng.integers(3), rng.random() < self.share, rng.uniform(-0.12, 0.12, 3)
                if not wrong:
                    continue
                if kind == 0:
                    error = -1.6 * detail[box]
                elif kind == 1:
                    error = 1.5 * detail[box].flip(0, 1)
                else:
                    error = torch.from_numpy(shade).to(truth) + 0.8 * detail[box]
                result[box] = truth[box] + self.strength * error
        return images.quantize(result)


@dataclass(frozen=True, slots=True)
class Surface:
    """A textured shape: where a ray meets it, where on the texture, and facing where."""

    texture: str
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    repeat: float = 1.0

    def hit(self, origin: Array, rays: Array) -> Array:
        """Distance along each ray, infinite where it misses."""
        raise NotImplementedError

    def surface(self, points: Array) -> tuple[Array, Array]:
        """Texture coordinates in [0, 1]² (before repetition) and unit normals."""
        raise NotImplementedError

    def extent(self) -> float:
        """World length of one texture width."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Panel(Surface):
    """A rectangle: its centre, and half its sides as vectors."""

    center: tuple[float, float, float] = (0, 0, 0)
    right: tuple[float, float, float] = (1, 0, 0)
    down: tuple[float, float, float] = (0, 1, 0)

    def hit(self, origin: Array, rays: Array) -> Array:
        normal = np.cross(self.right, self.down)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((np.asarray(self.center) - origin) @ normal) / (rays @ normal)
            u, v = self._coordinates(origin + t[:, None] * rays)
            inside = (t > 1e-6) & (np.abs(u) <= 1) & (np.abs(v) <= 1)
        return np.asarray(np.where(inside, t, np.inf))

    def surface(self, points: Array) -> tuple[Array, Array]:
        u, v = self._coordinates(points)
        normal = np.cross(self.right, self.down)
        return np.stack(((u + 1) / 2, (v + 1) / 2), -1), np.broadcast_to(normal / np.linalg.norm(normal), points.shape)

    def extent(self) -> float:
        return 2 * float(np.linalg.norm(self.right)) / self.repeat

    def _coordinates(self, points: Array) -> tuple[Array, Array]:
        offset = points - np.asarray(self.center)
        right, down = np.asarray(self.right, float), np.asarray(self.down, float)
        return offset @ right / (right @ right), offset @ down / (down @ down)


@dataclass(frozen=True, slots=True)
class Ball(Surface):
    """A sphere, its texture wrapped by longitude and latitude."""

    center: tuple[float, float, float] = (0, 0, 0)
    radius: float = 1.0

    def hit(self, origin: Array, rays: Array) -> Array:
        offset = origin - np.asarray(self.center)
        b = rays @ offset
        square = np.einsum("ij,ij->i", rays, rays)
        discriminant = b * b - square * (offset @ offset - self.radius**2)
        t = (-b - np.sqrt(np.maximum(discriminant, 0))) / square
        return np.where((discriminant > 0) & (t > 1e-6), t, np.inf)

    def surface(self, points: Array) -> tuple[Array, Array]:
        normal = (points - np.asarray(self.center)) / self.radius
        longitude = np.arctan2(normal[:, 0], -normal[:, 2]) / (2 * math.pi) + 0.5
        latitude = np.arccos(np.clip(-normal[:, 1], -1, 1)) / math.pi
        return np.stack((longitude, latitude), -1), normal

    def extent(self) -> float:
        return 2 * math.pi * self.radius / self.repeat


def _tilted(angle: float, half_width: float, half_height: float, lean: float = 0.0) -> dict[str, tuple[float, ...]]:
    """Half sides of an upright panel turned about the vertical by `angle`, leaning back by `lean` radians."""
    c, s = math.cos(angle), math.sin(angle)
    return {
        "right": (half_width * c, 0.0, half_width * s),
        "down": (half_height * s * math.sin(lean), half_height * math.cos(lean), -half_height * c * math.sin(lean)),
    }


ROOM: Final[tuple[Surface, ...]] = (
    Panel("brick", (0.92, 0.66, 0.54), 3.0, center=(0, -0.6, 7.5), right=(7, 0, 0), down=(0, 3.2, 0)),
    Panel("gravel", (0.72, 0.70, 0.66), 4.0, center=(0, 1.35, 4.5), right=(7, 0, 0), down=(0, 0, -4.5)),
    Panel("rocket", center=(-1.15, -0.75, 7.42), right=(1.15, 0, 0), down=(0, 0.77, 0)),
    Panel("hubble_deep_field", center=(2.55, -0.8, 7.42), right=(0.95, 0, 0), down=(0, 0.83, 0)),
    Panel("astronaut", center=(-2.1, 0.35, 5.4), **_tilted(0.45, 0.85, 0.95, 0.12)),  # type: ignore[arg-type]
    Panel("chelsea", center=(1.55, 0.62, 4.7), **_tilted(-0.5, 0.95, 0.63, 0.15)),  # type: ignore[arg-type]
    Panel("coffee", center=(0.35, 0.1, 6.3), **_tilted(-0.12, 0.9, 0.6)),  # type: ignore[arg-type]
    Ball("ihc", (1.0, 1.0, 1.0), 2.0, center=(-0.75, 0.8, 4.1), radius=0.5),
    Ball("retina", (1.0, 0.9, 0.8), 2.0, center=(0.45, 1.0, 3.7), radius=0.34),
    Ball("grass", (0.55, 0.85, 0.4), 2.0, center=(-1.55, 1.05, 3.5), radius=0.28),
)


def render(camera: Camera, room: tuple[Surface, ...] = ROOM) -> Float[Tensor, "H W 3"]:
    """Ray-cast with 4 × 4 rays a pixel and prefiltered textures; 8-bit values, as a photo would have."""
    n = _SUPERSAMPLING
    rows = []
    for first in range(0, camera.height, 32):
        height = min(32, camera.height - first)
        colors = _cast(camera, room, first, height).reshape(height, n, camera.width, n, 3)
        rows.append(colors.mean(axis=(1, 3)))
    return images.quantize(torch.from_numpy(np.concatenate(rows).astype(np.float32)))


def depth(camera: Camera, room: tuple[Surface, ...] = ROOM) -> Float[Tensor, "H W"]:
    """Depth (z) through each pixel's centre, infinite where nothing is; the truth that tests compare with."""
    origin, rays = _rays(camera, 0, camera.height, 1)
    t = np.min([shape.hit(origin, rays) for shape in room], axis=0)
    return torch.from_numpy(t.reshape(camera.height, camera.width))


def _cast(camera: Camera, room: tuple[Surface, ...], first: int, height: int) -> Array:
    origin, rays = _rays(camera, first, height, _SUPERSAMPLING)
    distances = np.stack([shape.hit(origin, rays) for shape in room])
    nearest = distances.argmin(0)
    colors = np.zeros((len(rays), 3))
    for k, shape in enumerate(room):
        mine = (nearest == k) & np.isfinite(distances[k])
        if mine.any():
            t = distances[k][mine]
            uv, normal = shape.surface(origin + t[:, None] * rays[mine])
            texels_per_world = _pyramid(shape.texture)[0].shape[1] / shape.extent()
            footprint = t.mean() / (camera.fx * _SUPERSAMPLING) * texels_per_world  # texels between two rays
            albedo = _sample(shape.texture, uv * shape.repeat, footprint) * np.asarray(shape.tint)
            facing = np.abs(normal @ _LIGHT)
            colors[mine] = albedo * (_AMBIENT + (1 - _AMBIENT) * facing)[:, None] * 1.15
    return np.clip(colors, 0, 1)


def _rays(camera: Camera, first: int, height: int, per_pixel: int) -> tuple[Array, Array]:
    """Origin and directions (z = 1 in the camera) of all rays of some image rows."""
    pose = camera.world_to_camera.double().numpy()
    x = (np.arange(camera.width * per_pixel) + 0.5) / per_pixel
    y = (np.arange(height * per_pixel) + 0.5) / per_pixel + first
    u, v = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    local = np.stack((u.ravel(), v.ravel(), np.ones(u.size)), -1)
    return camera.center.double().numpy(), local @ pose[:3, :3]


def _sample(texture: str, uv: Array, footprint: float) -> Array:
    """Bilinear look-up in the level of the image pyramid whose texels are about as large as the ray spacing."""
    pyramid = _pyramid(texture)
    level = pyramid[int(np.clip(round(math.log2(max(footprint, 1.0))), 0, len(pyramid) - 1))]
    height, width = level.shape[:2]
    # Repeated textures are mirrored, so that they have no seam.
    folded = 1 - np.abs(1 - uv % 2)
    x, y = folded[:, 0] * width - 0.5, folded[:, 1] * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    x0, x1 = np.clip(x0, 0, width - 1), np.clip(x0 + 1, 0, width - 1)
    y0, y1 = np.clip(y0, 0, height - 1), np.clip(y0 + 1, 0, height - 1)
    upper = level[y0, x0] * (1 - fx) + level[y0, x1] * fx
    lower = level[y1, x0] * (1 - fx) + level[y1, x1] * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


@lru_cache(maxsize=32)
def _pyramid(texture: str) -> tuple[Array, ...]:
    """A shipped photograph and its halvings (area means), RGB in [0, 1]."""
    import skimage

    folder = Path(skimage.__file__).parent / "data"
    path = next(p for suffix in (".png", ".jpg") if (p := folder / f"{texture}{suffix}").exists())
    with Image.open(path) as photo:
        level = np.asarray(photo.convert("RGB"), np.float64) / 255
    levels = [level]
    while min(level.shape[:2]) > 4:
        level = level[: level.shape[0] // 2 * 2, : level.shape[1] // 2 * 2]
        level = (level[0::2, 0::2] + level[1::2, 0::2] + level[0::2, 1::2] + level[1::2, 1::2]) / 4
        levels.append(level)
    return tuple(levels)


def _camera(position: float, width: int, height: int) -> Camera:
    """On the arc, `position` in [-1, 1] from left to right, looking at the room's middle."""
    center = np.array([_ARC * position, -0.15 + 0.12 * math.cos(2.2 * position), 0.35 * position**2])
    forward = (_TARGET - center) / np.linalg.norm(_TARGET - center)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack((right, np.cross(forward, right), forward))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    focal = width / (2 * math.tan(_FIELD_OF_VIEW / 2))
    return Camera(torch.from_numpy(pose), focal, focal, width / 2, height / 2, width, height)
