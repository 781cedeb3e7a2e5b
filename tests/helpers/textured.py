"""Photos of a textured surface z = f(x, y), cast by fixed-point iteration, with their exact depth."""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import Photo
from rasterizers.interface import Camera

Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]


def slanted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A plane that recedes to the right."""
    return 4 + 0.3 * x


def bump(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The front of a sphere of radius 3 around (0, 0, 6), with its rim continued as a plane."""
    return 6 - np.sqrt(np.clip(9 - x**2 - y**2, 4, None))


def camera(x: float, degrees: float = 0.0, size: tuple[int, int] = (64, 48)) -> Camera:
    """At (x, 0, 0), turned about y by `degrees` towards -x, focal length as long as the image is wide."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    R = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    pose = torch.eye(4)
    pose[:3, :3] = R
    pose[:3, 3] = -R @ torch.tensor([x, 0, 0])
    width, height = size
    return Camera(pose, float(width), float(width), width / 2, height / 2, width, height)


def cast(surface: Surface, seen: Camera) -> tuple[Photo, Float[Tensor, "H W"]]:
    """(photo, z of each pixel)."""
    x, y = np.meshgrid(np.arange(seen.width) + 0.5, np.arange(seen.height) + 0.5)
    rays = np.stack(((x - seen.cx) / seen.fx, (y - seen.cy) / seen.fy, np.ones_like(x)), -1)
    pose = seen.world_to_camera.double().numpy()
    directions, center = rays @ pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    depth = np.full(x.shape, 4.0)
    for _ in range(60):
        at = center + depth[..., None] * directions
        depth += 0.7 * (surface(at[..., 0], at[..., 1]) - at[..., 2])
    at = center + depth[..., None] * directions
    return Photo(seen, torch.from_numpy(_texture(at[..., 0], at[..., 1])).float()), torch.from_numpy(depth)


def _texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sums of waves in random directions, the shortest some 5 px long in the photos here."""
    random = np.random.default_rng(0)
    colors = np.zeros((*x.shape, 3))
    for _ in range(40):
        angle, frequency, phase = random.uniform(0, math.pi), random.uniform(4, 20), random.uniform(0, 7)
        wave = np.sin(frequency * (x * math.cos(angle) + y * math.sin(angle)) + phase)
        colors += 0.03 * wave[..., None] * random.uniform(0.3, 1, 3)
    return np.clip(0.5 + colors, 0, 1)
