"""nerfstudio's training photos as views. Reads nerfstudio's data managers without importing nerfstudio.

The LR side of a view is the photo that splatfacto trains on, undistorted by its data manager. The HR side is an SR image from
a folder or a network.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import View
from clear_strategies.data.priors import Bicubic, Images, Onnx, Prior, cached
from clear_strategies.errors import DataError, SettingError
from integration.views import HostPhoto, require_unique, stereo_points


def prior(sr: Path | None) -> Prior:
    """The source of SR images: a folder, an ONNX network, or bicubic interpolation if `sr` is None."""
    if sr is None:
        return Bicubic()
    return cached(Onnx(str(sr))) if sr.suffix.lower() == ".onnx" else Images(str(sr))


def views_from_datamanager(
    datamanager: Any, sr: Prior, factor: int, device: torch.device | str = "cpu"
) -> tuple[View, ...]:
    """The training views of a `FullImageDatamanager` on `device`, named like their files.

    Args:
        sr: called once per photo. factor: HR pixels per LR pixel.

    Raises:
        DataError: two photos have the same stem, a photo has a mask, or an SR image does not fit.
        SettingError: the photos are not kept in memory.
    """
    files = datamanager.train_dataset.image_filenames
    require_unique(Path(file).name for file in files)
    if masked := [Path(file).name for file, item in zip(files, _cached(datamanager), strict=True) if "mask" in item]:
        raise DataError(
            masked[0], "mask", "hides pixels from splatfacto's loss but not from the losses of the SR image",
            "train without masks",
        )  # fmt: skip
    return tuple(photo.view(sr, factor) for photo in photos_of(datamanager, device))


def seed_with_stereo(datamanager: Any) -> PointCloud:
    """Replace the data set's points, which the pipeline gives to its model, by the stereo cloud of a `FullImageDatamanager`'s
    undistorted training photos, in the world of its cameras. Pixels that a mask hides, or alpha, get no points.

    Raises:
        DataError: there are fewer than two photos, or stereo confirms no depth.
        SettingError: the photos are not kept in memory.
    """
    photos, items = photos_of(datamanager), _cached(datamanager)
    cloud = stereo_points([replace(photo, mask=_mask(item)) for photo, item in zip(photos, items, strict=True)])
    metadata = datamanager.train_dataparser_outputs.metadata
    for name in [name for name in metadata if name.startswith("points3D_")]:  # also errors and tracks of the old points
        del metadata[name]
    metadata |= {"points3D_xyz": cloud.means, "points3D_rgb": (cloud.colors * 255).round().to(torch.uint8)}
    return cloud


def photos_of(datamanager: Any, device: torch.device | str = "cpu") -> list[HostPhoto]:
    """The photos that splatfacto trains on, undistorted and over black, in the world of the data manager's cameras."""
    items = _cached(datamanager)  # read first: it undistorts the photos and corrects the cameras
    cameras, files = datamanager.train_dataset.cameras, datamanager.train_dataset.image_filenames
    Ks, poses = cameras.get_intrinsics_matrices(), world_to_camera(cameras.camera_to_worlds)
    return [
        HostPhoto(Path(file).name, over_black(item["image"]).to(device), pose.to(device), K)
        for file, item, pose, K in zip(files, items, poses, Ks, strict=True)
    ]


def world_to_camera(camera_to_world: Float[Tensor, "*C 3 4"]) -> Float[Tensor, "*C 4 4"]:
    """World to camera with OpenCV axes, from nerfstudio's poses: camera to world with OpenGL axes (y up, z back)."""
    R = (camera_to_world[..., :3] * camera_to_world.new_tensor([1, -1, -1])).mT  # scale the columns, then transpose
    pose = torch.eye(4).to(R).repeat(*R.shape[:-2], 1, 1)
    pose[..., :3, :3] = R
    pose[..., :3, 3:] = -R @ camera_to_world[..., 3:]
    return pose


def over_black(image: Tensor) -> Float[Tensor, "H W 3"]:
    """RGB in [0, 1] of an 8-bit or float photo, composited over black as splatfacto does it."""
    values = image.float() / 255 if image.dtype == torch.uint8 else image
    return values[..., :3] * values[..., 3:] if values.shape[-1] == 4 else values


def _mask(item: Any) -> Float[Tensor, "H W"] | None:
    """1 where a photo shows the scene: what its mask shows, and not less than half transparent. None: everywhere."""
    image, mask = item["image"], item.get("mask")
    shown = []
    if image.shape[-1] == 4:
        shown.append(image[..., 3].float() / (255 if image.dtype == torch.uint8 else 1))
    if mask is not None:
        shown.append(mask.reshape(image.shape[:2]).to(image.device).float())
    return torch.stack(shown).amin(0) if shown else None


def _cached(datamanager: Any) -> Any:
    """The undistorted photos, which nerfstudio keeps in memory."""
    if getattr(getattr(datamanager, "config", None), "cache_images", "cpu") == "disk":
        raise SettingError(
            "cache_images: clear-splatfacto needs cpu or gpu, got disk: every photo is read once, before training begins."
        )
    return datamanager.cached_train
