"""Cameras of 3DGS and its forks: as views, and at another size or pose.

They keep their matrices for row vectors, and a projection to NDC. Each fork has some of the attributes that are named here.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.data.photo_files import SUFFIXES
from clear_strategies.errors import HostError, SettingError
from integration.views import HostPhoto, SuperResolve, require_unique
from rasterizers.interface import Camera

_SAME_POSE: Final = 1e-6  # largest difference between the entries of the poses of one camera and its copy
_IN_PIXELS: Final = ("image_width", "image_height", "focal_x", "focal_y", "fx", "fy", "cx", "cy")


class HostViews:
    """The training views of a 3DGS-style trainer, found by their camera objects.

    Args:
        cameras: all training cameras (`scene.getTrainCameras()`), each with its photo.
        sr: gives the SR images. factor: HR pixels per LR pixel.
        device: of the Gaussians.

    Attributes:
        all: by the order of the cameras. factor: of all views.
        masks: by the name of a view, what the host multiplies the LR image by after rendering.

    Raises: see `Attached`.
    """

    def __init__(
        self, cameras: Sequence[Any], sr: SuperResolve, factor: int, device: torch.device | str = "cpu"
    ) -> None:
        if not cameras:
            raise SettingError(
                "cameras: at least one training camera is needed, got none. Pass scene.getTrainCameras()."
            )
        require_unique(camera.image_name for camera in cameras)
        self.factor = factor
        photos = [photo_of(camera, device) for camera in cameras]
        self.all = tuple(photo.view(sr, factor) for photo in photos)
        self.masks = {photo.name: photo.mask for photo in photos if photo.mask is not None}
        self._by_name = {camera.image_name: (camera, view) for camera, view in zip(cameras, self.all, strict=True)}

    def find(self, camera: Any) -> View | None:
        """The view of a training camera, or of a copy: a camera of the same name and pose. None: it is another camera."""
        if (name := getattr(camera, "image_name", None)) not in self._by_name:
            return None
        original, view = self._by_name[name]
        poses = original.world_view_transform, camera.world_view_transform
        same = camera is original or float((poses[0] - poses[1].to(poses[0])).abs().max()) <= _SAME_POSE
        return view if same else None


def photo_of(camera: Any, device: torch.device | str = "cpu") -> HostPhoto:
    """The photo of a training camera, in the trainer's world and as it is trained on (its -r).

    `alpha_mask`, which 3DGS multiplies its rendering by, is the photo's alpha, and with --train_test_exp the half of a test photo
    that stays unseen.

    Raises:
        HostError: it is drawn at another size.
    """
    image, mask = camera.original_image.permute(1, 2, 0).detach().to(device), getattr(camera, "alpha_mask", None)
    size, drawn = (image.shape[1], image.shape[0]), (camera.image_width, camera.image_height)
    if size != drawn:
        raise HostError(
            f"{camera.image_name} is drawn at {drawn[0]}x{drawn[1]} pixels, but its photo has {size[0]}x{size[1]}. LR must be "
            "drawn at the photo's size, beside which HR is drawn here. A trainer that draws at HR, as SRGS does, does not work; "
            "clear-strategies +method=srgs is its method."
        )
    shown = None if mask is None or bool((mask == 1).all()) else mask[0].to(image)
    name = camera.image_name  # some hosts drop the ending, also of a name that contains dots
    name = name if Path(name).suffix.lower() in SUFFIXES else f"{name}.png"
    return HostPhoto(name, image, camera.world_view_transform.T, intrinsics(camera), mask=shown)


def intrinsics(camera: Any) -> Float[Tensor, "3 3"]:
    """K in pixels, from the host's projection (for row vectors, to NDC)."""
    pose, full = (m.detach().double().cpu() for m in (camera.world_view_transform, camera.full_proj_transform))
    projection = torch.linalg.solve(pose, full)
    w, h = camera.image_width / 2, camera.image_height / 2
    fx, fy, cx, cy = projection[0, 0], projection[1, 1], projection[2, 0], projection[2, 1]
    return torch.tensor([[fx * w, 0, (cx + 1) * w], [0, fy * h, (cy + 1) * h], [0, 0, 1]], dtype=torch.float64)


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
