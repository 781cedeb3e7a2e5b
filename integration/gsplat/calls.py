"""Calls of gsplat's `rasterization`, as dicts of arguments: finds the view of a call; changes its size, camera or colours; and
converts its result for `Attachment`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.errors import HostError
from clear_strategies.geometry.projection import intrinsics
from integration.autograd_shot import AutogradShot, HostOutput, ScreenGradientSlot
from integration.hr_drawing import Drawable
from integration.pending import widened
from integration.views import SAME_POSE, require_intrinsics
from rasterizers.as_gsplat import cameras_of
from rasterizers.differentiable import collected_drawings
from rasterizers.geometry import SH_C0
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer
from rasterizers.torch_internals import base_of

Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
Call = Mapping[str, Any]
"""The arguments by name."""
_LENS: Final = (
    "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs", "lidar_coeffs", "external_distortion_coeffs",
    "viewmats_rs", "rays",
)  # fmt: skip
_POSE_RATIO: Final = 10  # by which the second nearest pose must be farther away, since frames of a video lie close


def draws_its_arguments(rasterization: Rasterization) -> bool:
    """Return True for gsplat's function and this package's; one that calls them may also change colours, say."""
    function: Any = rasterization.func if isinstance(rasterization, partial) else rasterization
    while _defined_in(function) == "contextlib":  # gsplat 1.6's is decorated by a context that traces it
        function = function.__wrapped__
    return _defined_in(function) in ("gsplat", "rasterizers")


def _defined_in(function: Any) -> str:
    """The package whose code this is; `functools.wraps` copies `__module__`."""
    module: str = getattr(function, "__globals__", {}).get("__name__", "")
    return module.partition(".")[0]


def cameras_read(call: Call) -> dict[str, Tensor]:
    """`viewmats` and `Ks` of a call in the CPU's memory. From a device both come in one transfer, for which the host waits."""
    viewmats, Ks = (call[name].detach() for name in ("viewmats", "Ks"))
    flat = viewmats.reshape(-1), Ks.to(viewmats.device).reshape(-1)
    together = torch.cat(flat).cpu()  # in the wider of their types
    poses, K = torch.split(together, [viewmats.numel(), Ks.numel()])
    return {"viewmats": poses.view(viewmats.shape).to(viewmats.dtype), "Ks": K.view(Ks.shape).to(Ks.dtype)}


class Poses:
    """Finds the view of a call by its pose, if the loop does not name the view."""

    def __init__(self, views: Sequence[View]) -> None:
        self._views = tuple(views)
        self._poses = torch.stack([view.lr.camera.world_to_camera for view in views]).double().cpu().numpy()

    def find(self, viewmats: Float[Tensor, "*C 4 4"]) -> View | None:
        """The view with this pose, in the CPU's memory; None: no training view has it.

        Raises:
            HostError: there are several poses, two views have this one, or it is rounded to bfloat16.
        """
        if viewmats.dtype is torch.bfloat16:
            raise HostError(
                "viewmats must be float32 or float64, got bfloat16, which moves a camera by up to 1 / 256 of its position. Leave "
                "the cameras out of what is converted."
            )
        poses = viewmats.reshape(-1, 4, 4).numpy()  # compared in numpy: a step has few torch operations
        if len(poses) != 1:
            raise HostError(
                f"one view is rendered at a time, got {len(poses)}. For several in a step, call backward() after each; see "
                "accumulation=; in simple_trainer.py set batch_size=1."
            )
        distances = np.abs(self._poses - poses).max((1, 2)).tolist()
        tolerance = SAME_POSE * max(1.0, float(np.abs(poses).max()))
        near = sorted((distance, i) for i, distance in enumerate(distances) if distance <= tolerance)
        if len(near) > 1 and near[1][0] <= _POSE_RATIO * near[0][0]:
            names = " and ".join(self._views[i].name for _, i in near[:2])
            raise HostError(f"{names} have the same pose. Say which is rendered: with clear.rendering(view): …")
        return self._views[near[0][1]] if near else None


def require_photo(call: Call, view: View, n: int) -> None:
    """Raise a HostError unless a call draws all n Gaussians of one scene, at the size of the view's photo."""
    drawn, lr = call["means"], view.lr.camera
    if drawn.dim() > 2:
        raise HostError(
            f"{view.name} is rendered with batches of scenes, means {[*drawn.shape]}. Leave out what is in front of {[n, 3]}, of "
            "all tensors of the call."
        )
    if len(drawn) != n:
        raise HostError(
            f"{view.name} is rendered with {len(drawn):,} of {n:,} Gaussians, and it is unknown which. Render all of them, or "
            "for a pass that shows a part: with clear.rendering(None): …"
        )
    if (call["width"], call["height"]) != (lr.width, lr.height):
        raise HostError(
            f"{view.name} is rendered at {call['width']}x{call['height']}, but its photo has {lr.width}x{lr.height} pixels. "
            "Train at one resolution (nerfstudio: num_downscales=0), cut a crop out of the picture of the whole photo, and "
            "evaluate without gradients."
        )


def of_one_camera(call: Call) -> dict[str, Any]:
    """The call of one camera with its colours by Gaussian, [N, …], also if they are given by camera, [1, N, …]."""
    colors, by_gaussian = call["colors"], 2 if call.get("sh_degree") is None else 3
    # A function of a loop's own may have a degree as its default.
    is_by_camera = colors.dim() > by_gaussian and len(colors) == 1
    return {**call, "colors": colors[0] if is_by_camera else colors}


def require_own_intrinsics(Ks: Float[Tensor, "*C 3 3"], view: View) -> None:
    """Raise a HostError if K of a call, in the CPU's memory, is not that of the view's photo."""
    (fx, _, cx), (_, fy, cy), _ = Ks.reshape(3, 3).tolist()
    remedy = (
        "Pass view() the K of the loop, and cut a crop out of the whole picture. A loop that optimizes K names the view: with "
        "clear.rendering(view): …"
    )
    require_intrinsics(view.name, (fx, fy, cx, cy), view.lr.camera, remedy)


def enlarged(call: Call, factor: int) -> dict[str, Any]:
    """The call with `factor` times as many pixels along an edge, for colours only."""
    Ks = torch.cat((call["Ks"][..., :2, :] * factor, call["Ks"][..., 2:, :]), -2)
    return {**call, "Ks": Ks, "width": call["width"] * factor, "height": call["height"] * factor, "render_mode": "RGB"}


def require_pinhole(call: Call, showing: Sequence[object]) -> None:
    """Raise a HostError for other cameras if strategies have extra views, since these are warped by pinhole cameras."""
    if not showing:
        return
    model = call.get("camera_model", "pinhole")
    lens = [name for name in _LENS if call.get(name) is not None] + [f"camera_model={model}"] * (model != "pinhole")
    if lens:
        raise HostError(
            f"{', '.join(type(s).__name__ for s in showing)} must have pinhole cameras, got {', '.join(lens)}. Undistort the "
            "photos, or leave out the strategy."
        )


def seen_by(call: Call, camera: Camera) -> dict[str, Any]:
    """The call from another camera, for colours only."""
    viewmats, Ks = call["viewmats"], call["Ks"]
    return {
        **call, "viewmats": camera.world_to_camera.to(viewmats).reshape(viewmats.shape),
        "Ks": intrinsics(camera).to(Ks).reshape(Ks.shape), "width": camera.width, "height": camera.height, "render_mode": "RGB",
    }  # fmt: skip


def with_offset(call: Call, detail: Float[Tensor, "*B N 3"], *, is_ours: bool) -> dict[str, Any]:
    """The call with f_det as an offset of the colours.

    Args:
        is_ours: the function is this package's, which has an argument for the offset.
    """
    colors, as_bands = widened(call["colors"]), call.get("sh_degree") is not None
    if is_ours and as_bands:
        return {**call, "rgb_offset": detail.to(call["means"].dtype)}
    if detail.dim() > 2:  # of several scenes, whose cameras may have colours of their own
        cameras = [1] * (colors.dim() - detail.dim() - as_bands)
        detail = detail.view(*detail.shape[:-2], *cameras, *detail.shape[-2:])
    if not as_bands:
        return {**call, "colors": colors + detail.to(colors)}
    constant = colors[..., :1, :] + (detail[..., None, :] / SH_C0).to(colors)
    return {**call, "colors": torch.cat((constant, colors[..., 1:, :]), -2)}


def aliased(call: Call) -> tuple[dict[str, Any], tuple[Tensor, ...]]:
    """The call with aliases of all tensors that require gradients, and the aliases. An alias shares the memory, but has none of
    the loop's hooks.
    """
    aliases = {name: x.view_as(x) for name, x in call.items() if isinstance(x, Tensor) and x.requires_grad}
    return {**call, **aliases}, tuple(aliases.values())


def drawable(rasterizer: Rasterizer, call: Call, params: Mapping[str, Tensor], camera: Camera | None) -> Drawable:
    """The `Drawable` of a call.

    Args:
        camera: None: that of the call, which is in the CPU's memory.
    """
    if camera is None:
        viewmats, Ks = call["viewmats"].reshape(1, 4, 4), call["Ks"].reshape(1, 3, 3)
        (camera,) = cameras_of(viewmats, Ks, call["width"], call["height"])
    behind = call.get("backgrounds")
    background = call["means"].new_zeros(1, 3) if behind is None else behind.detach().reshape(1, 3).float()
    colors = call["colors"].to(call["means"].dtype)  # float16 in some hosts
    inputs = Inputs(call["means"], call["quats"], call["scales"], call["opacities"], colors, params.get("detail"))
    return Drawable(rasterizer, camera, inputs, (call["sh_degree"] + 1) ** 2, background, params)


def host_output(
    rasterization: Rasterization, call: Call, params: Mapping[str, Tensor], gate: Float[Tensor, " N"] | None,
    marks: Sequence[Tensor] | None = None,
) -> HostOutput:  # fmt: skip
    """Render. Gaussians that the gate drops are marked as invisible in `info`.

    Args:
        marks: more of the `HostOutput`'s than the picture; None: it needs none.

    Raises:
        HostError: the function does not return what gsplat's does.
    """
    with collected_drawings() as drawings:
        result = rasterization(**call)
    if len(result) != 3:
        raise HostError(
            f"the wrapped function returns {len(result)} values, gsplat's rasterization returns 3: colours, alphas and info. "
            "2DGS draws other primitives and is not supported."
        )
    renders, alphas, info = result
    size, n, packed = (call["width"], call["height"]), len(params["means"]), info["means2d"].dim() == 2
    rows = info.get("gaussian_ids") if packed else None
    means2d = info["means2d"].detach().reshape(-1, 2)
    if len(drawings) == 1:  # in which dropped Gaussians are invisible
        means2d, visible = drawings[0].rendering.means2d, drawings[0].rendering.visible
    else:
        radii: Tensor = info["radii"]
        has_two = radii.dim() == (2 if packed else 3)  # of each Gaussian, since gsplat 1.5
        visible = (radii > 0).all(-1) if has_two else radii > 0
        if gate is not None:
            kept = (gate > 0)[rows] if rows is not None else gate > 0
            visible = visible & kept
            info["radii"] = radii * (kept[:, None] if has_two else kept).to(radii)
        visible = visible.reshape(-1)
        if rows is not None:
            means2d = means2d.new_zeros(n, 2).index_copy_(0, rows, means2d)
            visible = torch.zeros(n, dtype=torch.bool, device=rows.device).index_copy_(0, rows, visible)
    image = renders[..., :3].reshape(size[1], size[0], 3)
    names = ("means", "quats", "scales", "opacities", "colors")
    drawn = {name: call[name] for name in names if call.get(name) is not None}
    slot = ScreenGradientSlot(info["means2d"], size, rows=rows)
    around = [call[name] for name in ("viewmats", "Ks", "backgrounds") if call.get(name) is not None]
    shot = AutogradShot(image, means2d, visible, params, slot, drawn, drawings, around=around)
    if marks is not None:  # the function may also read parameters that it is not given
        marks = [*marks, *(base_of(x) for x in (renders, alphas) if x is not None and x.requires_grad)]
    return HostOutput(shot, (renders, alphas, info), marks or ())
