"""A GaussianModel made again from dense stereo between the scene's training photos."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, Final

import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import Photo
from integration.errors import HostError
from integration.inria.cameras import intrinsics, mask_of
from integration.points import ELSEWHERE, stereo_points
from integration.views import posed_photo

_OPEN: Final = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def start_from_stereo(gaussians: Any, scene: Any, opt: Any) -> None:
    """Make the host's Gaussians again, by its own `create_from_pcd` and `training_setup(opt)`, from the stereo cloud.

    Args:
        gaussians: the GaussianModel, after `training_setup(opt)` and before a checkpoint is restored.
        scene: the Scene; its training photos are compared.
        opt: what the host passed to `training_setup`.

    Raises:
        HostError: the host has no create_from_pcd with the arguments that 3DGS and its forks have.
        DataError: there are fewer than two photos, or stereo confirms no depth.
    """
    cameras = scene.getTrainCameras()
    create, cloud_type = _host_functions(gaussians)
    given = {"pcd": None, "cam_infos": cameras, "spatial_lr_scale": _extent(gaussians, scene)}
    arguments = _arguments(gaussians, create, given)
    cloud = stereo_cloud(cameras, gaussians._xyz.device)
    means, colors = cloud.means.numpy(), cloud.colors.numpy()
    pcd = cloud_type(points=means, colors=colors, normals=torch.zeros_like(cloud.means).numpy())
    create(**arguments | {"pcd": pcd})
    gaussians.training_setup(opt)


def stereo_cloud(cameras: Sequence[Any], device: torch.device | str = "cpu") -> PointCloud:
    """The stereo cloud of a 3DGS-style trainer's cameras, e.g. of `scene.getTrainCameras()`, in its world.

    Args:
        cameras: with their photos; pixels that `alpha_mask` hides get no points.
        device: where the photos are compared.

    Raises:
        DataError: there are fewer than two photos, or stereo confirms no depth.
    """
    return stereo_points([_photo(camera, device) for camera in cameras], [mask_of(camera) for camera in cameras])


def _photo(camera: Any, device: torch.device | str) -> Photo:
    image = camera.original_image.permute(1, 2, 0).detach().to(device)
    return posed_photo(image, camera.world_view_transform.T, intrinsics(camera))


def _host_functions(gaussians: Any) -> tuple[Any, Any]:
    """(the model's create_from_pcd, the host's type of point clouds), which its module imports."""
    create = getattr(gaussians, "create_from_pcd", None)
    if create is None:
        raise HostError(
            f"points=stereo: {type(gaussians).__name__} has no create_from_pcd, which a GaussianModel has in 3DGS. {ELSEWHERE}"
        )
    names = getattr(inspect.unwrap(create), "__globals__", {})
    if "BasicPointCloud" not in names:
        raise HostError(
            f"points=stereo: the module of {type(gaussians).__name__} has no BasicPointCloud, which it has in 3DGS. {ELSEWHERE}"
        )
    return create, names["BasicPointCloud"]


def _arguments(gaussians: Any, create: Any, given: dict[str, Any]) -> dict[str, Any]:
    """What the host's create_from_pcd takes of `given`: forks have two or three of these arguments."""
    parameters = inspect.signature(create).parameters
    unknown = [
        name for name, p in parameters.items() if name not in given and p.default is p.empty and p.kind not in _OPEN
    ]
    if unknown or "pcd" not in parameters:
        raise HostError(
            f"points=stereo: {type(gaussians).__name__}.create_from_pcd must take pcd, and of others spatial_lr_scale and "
            f"cam_infos at most, as in 3DGS, got ({', '.join(parameters)}). {ELSEWHERE}"
        )
    return {name: value for name, value in given.items() if name in parameters}


def _extent(gaussians: Any, scene: Any) -> float:
    """The size of the scene, which 3DGS's Scene passes to create_from_pcd, and which that keeps."""
    for owner, name in ((scene, "cameras_extent"), (gaussians, "spatial_lr_scale")):
        if (found := getattr(owner, name, None)) is not None:
            return float(found)
    raise HostError(
        f"points=stereo: {type(scene).__name__} has no cameras_extent, which a Scene has in 3DGS. {ELSEWHERE}"
    )
