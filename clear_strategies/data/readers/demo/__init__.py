"""The demo, the default data set: a procedural room, which needs no download.

It holds pictures, boxes and balls at several depths, textured with photographs that scikit-image ships inside its wheel,
and is ray-cast with anti-aliasing from exact poses. The capture brings its own prior, `priors.DemoPrior`, which is synthetic.
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import require_whole
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.priors.corrupted import DemoPrior
from clear_strategies.data.readers.demo.room import LAMP, light_on, room
from clear_strategies.data.readers.demo.surfaces import Array, Rays, Surface, f32, photograph, unit
from clear_strategies.errors import SettingError
from rasterizers.interface import Camera

_RAYS: Final = 4  # per pixel and axis
_BAND: Final = 16  # image rows cast at once, few enough for the CPU's caches
_FIELD_OF_VIEW: Final = math.radians(58)
_ARC: Final = 0.75  # the cameras' largest offset to the left and right, world units
_TARGET: Final = np.array([0.0, 0.15, 5.0])


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
    return Capture("demo", tuple(frames), notes=notes, own_prior=DemoPrior, depth=depth)


def render(camera: Camera) -> Float[Tensor, "H W 3"]:
    """Ray-cast with 4 × 4 rays a pixel and prefiltered textures; 8-bit values, as a photo would have."""
    bands = []
    for first in range(0, camera.height, _BAND):
        rays = Rays.through(camera, first, min(first + _BAND, camera.height), _RAYS)
        colors = _cast(rays).reshape(-1, _RAYS, camera.width, _RAYS, 3)
        bands.append(colors.mean(axis=(1, 3)))
    return images.quantize(torch.from_numpy(np.concatenate(bands)).clamp(0, 1))


def depth(camera: Camera) -> Float[Tensor, "H W"]:
    """Depth (z) through each pixel's centre, infinite where there is no surface: the ground truth."""
    rays = Rays.through(camera, 0, camera.height, 1)
    return torch.from_numpy(np.min([surface.depth(rays) for surface in room()], axis=0))


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
