"""Cameras in viser's terms, for the viewer and the page of a splat."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
import viser

from clear_strategies.viewing import paths
from rasterizers.interface import Camera

_LENGTH: Final = 0.12  # of a camera in the scene, in mean distances from the cameras to what they look at


def aim(server: viser.ViserServer, cameras: Sequence[Camera]) -> None:
    """Look from the first camera at the distance of the point that all of them look at; without cameras, do nothing."""
    if not cameras:
        return
    axes = torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    up = -axes[:, 1].mean(0)
    server.scene.set_up_direction(tuple((up / up.norm().clamp_min(1e-9)).tolist()))
    first = cameras[0]
    distance = float(np.linalg.norm(paths.look_at(cameras) - first.center.double().numpy()))
    start = server.initial_camera
    start.position = tuple(first.center.tolist())
    start.look_at = tuple((first.center.double() + distance * first.world_to_camera[2, :3].double()).tolist())
    start.up = tuple((-first.world_to_camera[1, :3]).tolist())
    start.fov = vertical_fov(first)


def drawn_length(cameras: Sequence[Camera]) -> float:
    """How long a camera is drawn in the scene, world units."""
    focus = paths.look_at(cameras)
    return _LENGTH * float(np.mean([np.linalg.norm(camera.center.double().numpy() - focus) for camera in cameras]))


def vertical_fov(camera: Camera) -> float:
    """Radians."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def wxyz(camera: Camera) -> tuple[float, float, float, float]:
    """Its rotation, camera to world, as a quaternion."""
    rotation = viser.transforms.SO3.from_matrix(camera.world_to_camera[:3, :3].double().T.numpy())
    w, x, y, z = (float(value) for value in rotation.wxyz)
    return w, x, y, z
