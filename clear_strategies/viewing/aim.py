"""Cameras in viser's terms: where a page begins, and cameras in the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

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
    start.fov = 2 * math.atan(first.height / 2 / first.fy)


def drawn_length(cameras: Sequence[Camera]) -> float:
    """How long a camera is drawn in the scene, world units."""
    focus = paths.look_at(cameras)
    return _LENGTH * float(np.mean([np.linalg.norm(camera.center.double().numpy() - focus) for camera in cameras]))


def wxyz(camera: Camera) -> tuple[float, float, float, float]:
    """Its rotation, camera to world, as a quaternion."""
    rotation = viser.transforms.SO3.from_matrix(camera.world_to_camera[:3, :3].double().T.numpy())
    w, x, y, z = (float(value) for value in rotation.wxyz)
    return w, x, y, z


def add_camera(server: viser.ViserServer, name: str, camera: Camera, length: float, **look: Any) -> Any:
    """Draw a camera in the scene.

    Args:
        look: colour, image and visibility, as viser's `add_camera_frustum` takes them.
    """
    return server.scene.add_camera_frustum(
        name, fov=2 * math.atan(camera.height / 2 / camera.fy), aspect=camera.width / camera.height, scale=length,
        wxyz=wxyz(camera), position=tuple(camera.center.tolist()), **look,
    )  # fmt: skip
