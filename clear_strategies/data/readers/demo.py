"""The demo, the default data set: a procedural room, which needs no download.

It contains pictures, boxes and balls at several depths, textured with photographs from scikit-image's wheel, and is ray-cast
with anti-aliasing from exact poses. The capture has a synthetic prior of its own, `priors.DemoPrior`.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache
from threading import Lock
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import require_whole
from clear_strategies.core.view import Photo
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.priors.corrupted import DemoPrior
from clear_strategies.data.readers.demo_surfaces import (
    Array,
    Ball,
    Finish,
    Panel,
    Rays,
    Surface,
    Texture,
    Vector,
    f32,
    photograph,
    unit,
)
from clear_strategies.errors import SettingError
from rasterizers.interface import Camera

_RAYS: Final = 4  # per pixel and axis
_BAND: Final = 16  # image rows cast at once, few enough for the CPU's caches
_FIELD_OF_VIEW: Final = math.radians(58)
_ARC: Final = 0.75  # the cameras' largest offset to the left and right, world units
_TARGET: Final = np.array([0.0, 0.15, 5.0])
_FLOOR: Final = 1.35  # y; y points down
_WALL: Final = 7.5  # z
_LEAN: Final = 0.16  # of pictures on the ground, radians
_LAMP: Final = np.array([-4.0, -2.9, 1.2])
_LAMP_SIZE: Final = 0.9  # edge of the square lamp; an extended lamp has soft shadows
_LAMP_REACH: Final = 8.5  # distance at which its light is halved
_AMBIENT: Final = 0.3
_EXPOSURE: Final = 1.9
_LIGHT_TEXEL: Final = 0.08  # of the baked light, world units
_PREPARING: Final = Lock()


def read(*, width: int = 256, height: int = 192, views: int = 12, train: int = 3) -> Capture:
    """Make a capture of the room from cameras on an arc.

    Args:
        width, height: of the HR images.
        views: the number of cameras.
        train: the number of training views among them, evenly spaced, at least 2; the others are for testing.

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
        load = lru_cache(maxsize=1)(lambda camera=camera: Photo(camera, render(camera)))
        frames.append(Frame(f"demo_{i:02d}", camera, load, split="train" if i in chosen else "test"))
    notes = {"poses": "exact", "scene": "procedural room, photographs from scikit-image"}
    return Capture("demo", tuple(frames), notes=notes, own_prior=DemoPrior)


def render(camera: Camera) -> Float[Tensor, "H W 3"]:
    """Ray-cast with 4 × 4 rays a pixel and prefiltered textures; 8-bit values, as a photo would have."""
    with _PREPARING:  # one of the threads that render photos fills the caches for all
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
    """The camera on the arc at `position` in [-1, 1], from left to right, looking at the middle of the room."""
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
    hit = np.full(nearest.shape, -1, np.int8)
    for k, surface in enumerate(room()):
        distance = surface.depth(rays)
        hit[distance < nearest] = k
        np.minimum(nearest, distance, out=nearest)
    colors = np.zeros((nearest.size, 3), np.float32)
    for k, surface in enumerate(room()):
        index = np.flatnonzero(hit == k)
        if index.size:
            distance, directions = nearest.ravel()[index], rays.directions(index)
            points = f32(rays.origin) + distance[:, None] * directions
            colors[index] = _color(surface, points, directions, distance * rays.spacing)
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
        half = unit(unit(_LAMP - points) - unit(directions))
        color += finish.gloss * np.maximum((half * surface.normal(points)).sum(-1, keepdims=True), 0) ** 40
    return np.asarray(color, np.float32)


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


def _leaning(texture: str, *, x: float, z: float, width: float, turn: float) -> Panel:
    """A picture on the ground, turned about the vertical by this angle, radians, and leaning back."""
    half = width / 2
    tall = half / photograph(texture).aspect
    right, back = _turned(turn)
    down = tall * (math.cos(_LEAN) * np.array([0, 1, 0]) - math.sin(_LEAN) * back)
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
            lamp = _LAMP + np.array((dx, 0, dz))
            way = lamp - points
            distance = np.linalg.norm(way, axis=-1)
            cosine = np.maximum((way * normal).sum(-1) / distance, 0)
            shadowed = np.any([other.blocks(points, lamp) for other in room() if other is not surface], axis=0)
            direct += np.where(shadowed, 0, cosine) / (1 + (distance / _LAMP_REACH) ** 2) / offsets.size**2
    light = _EXPOSURE * (_AMBIENT * (0.75 - 0.25 * normal[:, 1]) + (1 - _AMBIENT) * direct)
    return Texture.of(light.reshape(height, width, 1), levels=1)
