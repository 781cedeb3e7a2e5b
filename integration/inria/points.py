"""A GaussianModel made again from dense stereo between the scene's training photos."""

from __future__ import annotations

import inspect
from typing import Any, Final

import torch

from integration.errors import HostError
from integration.inria.cameras import photo_of
from integration.points import ELSEWHERE, stereo_points

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
    cloud = stereo_points([photo_of(camera, gaussians._xyz.device) for camera in cameras])
    means, colors = cloud.means.numpy(), cloud.colors.numpy()
    pcd = cloud_type(points=means, colors=colors, normals=torch.zeros_like(cloud.means).numpy())
    create(**arguments | {"pcd": pcd})
    gaussians.training_setup(opt)


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
