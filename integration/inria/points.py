"""A GaussianModel made again from dense stereo between the scene's training photos."""

from __future__ import annotations

import inspect
from typing import Any, Final

import torch

from integration.inria.cameras import photo_of
from integration.points import no_stereo, stereo_points

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
    model, create = type(gaussians).__name__, getattr(gaussians, "create_from_pcd", None)
    if create is None:
        raise no_stereo(f"{model} has no create_from_pcd, which a GaussianModel has in 3DGS")
    point_cloud = getattr(inspect.unwrap(create), "__globals__", {}).get("BasicPointCloud")
    if point_cloud is None:
        raise no_stereo(f"the module of {model} has no BasicPointCloud, which it has in 3DGS")
    cameras = scene.getTrainCameras()
    extent = getattr(scene, "cameras_extent", getattr(gaussians, "spatial_lr_scale", None))
    if extent is None:
        raise no_stereo(f"{type(scene).__name__} has no cameras_extent, which a Scene has in 3DGS")
    known = {"pcd": None, "cam_infos": cameras, "spatial_lr_scale": float(extent)}  # forks take two or three of them
    parameters = inspect.signature(create).parameters
    unknown = [
        name for name, p in parameters.items() if name not in known and p.default is p.empty and p.kind not in _OPEN
    ]
    if unknown or "pcd" not in parameters:
        raise no_stereo(
            f"{model}.create_from_pcd must take pcd, and of others spatial_lr_scale and cam_infos at most, as in 3DGS, got "
            f"({', '.join(parameters)})"
        )
    cloud = stereo_points([photo_of(camera, gaussians._xyz.device) for camera in cameras])
    means, normals = cloud.means.numpy(), torch.zeros_like(cloud.means).numpy()
    pcd = point_cloud(points=means, colors=cloud.colors.numpy(), normals=normals)
    create(**{name: value for name, value in known.items() if name in parameters} | {"pcd": pcd})
    gaussians.training_setup(opt)
