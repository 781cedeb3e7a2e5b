"""Where viser's page begins: at the first camera, upright as the cameras are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import viser

from clear_strategies.viewing import paths
from rasterizers.interface import Camera


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
