"""Cameras of hosts whose `render` takes a camera object: 3DGS and its forks.

They keep their matrices for row vectors, and a projection to NDC; each fork has some of these attributes.
"""

from __future__ import annotations

import copy
import math
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from rasterizers.interface import Camera

_IN_PIXELS: Final = ("image_width", "image_height", "focal_x", "focal_y", "fx", "fy", "cx", "cy")


def enlarged_camera(camera: Any, factor: int) -> Any:
    """A copy of a host's camera with `factor` times as many pixels per edge; fields of view and projections stay."""
    larger = copy.copy(camera)
    for name in _IN_PIXELS:
        if hasattr(camera, name):
            setattr(larger, name, getattr(camera, name) * factor)
    return larger


def replaced_camera(camera: Any, by: Camera) -> Any:
    """A copy of a host's camera with the pose, the intrinsics and the size of `by`; depth planes and names stay."""
    pose = by.world_to_camera.double().cpu()
    view, full = pose.T, getattr(camera, "full_proj_transform", None)
    projection = None
    if full is not None:
        projection = torch.linalg.solve(camera.world_view_transform.double().cpu(), full.double().cpu())
        projection[0, 0], projection[1, 1] = 2 * by.fx / by.width, 2 * by.fy / by.height
        projection[2, 0], projection[2, 1] = 2 * by.cx / by.width - 1, 2 * by.cy / by.height - 1
    values: dict[str, Any] = {
        "image_width": by.width, "image_height": by.height,
        "focal_x": by.fx, "focal_y": by.fy, "fx": by.fx, "fy": by.fy, "cx": by.cx, "cy": by.cy,
        "FoVx": 2 * math.atan(by.width / (2 * by.fx)), "FoVy": 2 * math.atan(by.height / (2 * by.fy)),
        "R": pose[:3, :3].T, "T": pose[:3, 3], "camera_center": by.center.double().cpu(),
        "world_view_transform": view, "projection_matrix": projection,
        "full_proj_transform": None if projection is None else view @ projection,
    }  # fmt: skip
    moved = copy.copy(camera)
    for name, value in values.items():
        if getattr(camera, name, None) is not None and value is not None:
            setattr(moved, name, _like(value, getattr(camera, name)))
    return moved


def _like(value: Any, present: Any) -> Any:
    """The value as the host keeps it: on its device, in its type."""
    if isinstance(present, Tensor):
        return torch.as_tensor(value).to(present)
    if isinstance(present, np.ndarray):
        return np.asarray(value, dtype=present.dtype)
    return type(present)(value)
