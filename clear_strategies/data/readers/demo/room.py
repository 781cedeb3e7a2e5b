"""What stands in the demo's room, and the light on it."""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Float

from clear_strategies.data.readers.demo.surfaces import Array, Ball, Finish, Panel, Surface, Texture, Vector, photograph

_FLOOR: Final = 1.35  # y; y points down
_WALL: Final = 7.5  # z
LAMP: Final = np.array([-4.0, -2.9, 1.2])
_LAMP_SIZE: Final = 0.9  # edge of the square lamp; an extended lamp has soft shadows
_LAMP_REACH: Final = 8.5  # distance at which its light is halved
_AMBIENT: Final = 0.3
_EXPOSURE: Final = 1.9
_LIGHT_TEXEL: Final = 0.08  # of the baked light, world units


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
