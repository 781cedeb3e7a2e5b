"""`install`: one line in a 3DGS-style train.py, with every schedule read from the host's own options."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any, Final, cast

import torch

from clear_strategies.console import show_in_host
from clear_strategies.errors import HostError
from integration.densification import end_with_strategies
from integration.inria.attached import Attached
from integration.inria.cameras import photo_of
from integration.settings import Settings
from integration.views import no_stereo, stereo_points

_OPEN: Final = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def install(gaussians: Any, scene: Any, opt: Any, settings: Settings | None = None, **changes: Any) -> Attached:
    """Train the host's Gaussians with CLEAR; `gaussian_renderer.render` is replaced wherever it was imported.

    Args:
        gaussians: the GaussianModel, after `training_setup(opt)` and before a checkpoint is restored.
        scene: the Scene with the training cameras.
        opt: the options that the host passed to `training_setup`. `iterations` stretches the schedules,
            `densify_grad_threshold` scales P2G's score, and `densify_until_iter` is lowered to the iteration at which a
            strategy ends densification.
        settings: None: the defaults. With points="stereo" the Gaussians are made again by the host's `create_from_pcd` and
            `training_setup`; a checkpoint that is restored later replaces them.
        changes: fields of `Settings` in place of those, e.g. sr="sr_x4".

    Raises:
        HostError: the host has another shape than 3DGS.
        SettingError: see `Settings` and `Attached`.
        DataError: see `Attached`; stereo confirms no depth.
    """
    show_in_host()
    render = training_render(sys.modules.get("gaussian_renderer"))
    wanted = replace(settings or Settings(), **changes)
    iterations = getattr(opt, "iterations", None)
    if iterations is None:
        raise HostError(f"{type(opt).__name__} has no iterations, which the options of training_setup have in 3DGS.")
    chosen = wanted.conductor(int(iterations))
    if wanted.points == "stereo":
        start_from_stereo(gaussians, scene, opt)
    end_with_strategies(chosen, opt, "densify_until_iter")
    attached = Attached(
        gaussians, scene.getTrainCameras(), chosen, sr=wanted.sr, suffix=wanted.suffix, factor=wanted.factor, seed=wanted.seed,
        threshold=getattr(opt, "densify_grad_threshold", None), densify_until=getattr(opt, "densify_until_iter", None),
        own_background=bool(getattr(opt, "random_background", False)), accumulation=wanted.accumulation,
    )  # fmt: skip
    attached.replace_everywhere(render)
    return attached


def training_render(renderer: ModuleType | None) -> Callable[..., Any]:
    """The function `render` of a host's module gaussian_renderer; in one without it, the only function whose name begins so, as
    FastGS's `render_fastgs`.

    Raises:
        HostError: there is none, or there are several.
    """
    names = [name for name in dir(renderer) if name.startswith("render")]
    chosen = ["render"] if "render" in names else names
    if len(chosen) != 1:
        raise HostError(
            "gaussian_renderer must be imported, and have a function render, as in 3DGS, got "
            f"{', '.join(names) or 'none'}. Use attach, and replace_everywhere of the function that the loop trains with."
        )
    return cast(Callable[..., Any], getattr(renderer, chosen[0]))


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
