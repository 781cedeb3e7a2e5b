"""`render` of 3DGS and its forks takes the whole model: render it with gated opacities and with f_det in its colours, at LR or
HR.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.errors import HostError
from integration.autograd_shot import AutogradShot, HostOutput, ScreenGradientSlot
from integration.detail import sh0_offset
from rasterizers.differentiable import Drawing
from rasterizers.interface import Camera
from rasterizers.torch_internals import base_of

Role = Literal["gate", "detail"]
"""The changes of an override: opacities are multiplied by the gate, colours are offset by f_det."""
_ROLES: Final[Mapping[str, Role]] = {
    "get_opacity": "gate", "get_opacity_with_3D_filter": "gate", "get_scaling_n_opacity_with_3D_filter": "gate",
    "_features_dc": "detail",
}  # fmt: skip
"""A model's getters, methods and attributes, those that it has. Of role "gate" are opacities (or a tuple that ends with them), of
role "detail" is the constant band of the colours.
"""


@dataclass(slots=True, eq=False)
class Overrides:
    """What a proxy changes in its model.

    Args:
        gate: z, a factor of every opacity; None: opacities stay.
        detail: f_det, an offset of every colour; None: colours stay.
        used: the roles that the host has read.
        active: roles whose getter is running; getters that it calls are not changed a second time.
    """

    gate: Float[Tensor, " N"] | None = None
    detail: Float[Tensor, "N 3"] | None = None
    used: set[Role] = field(default_factory=set)
    active: set[Role] = field(default_factory=set)

    def of(self, role: Role, get: Callable[[], Any]) -> Any:
        """What `get` returns, changed once."""
        if role in self.active:
            return get()
        self.active.add(role)
        try:
            return _apply(get(), self, role)
        finally:
            self.active.discard(role)


def proxy(model: Any, overrides: Overrides) -> Any:
    """An object of the model's class that shares its attributes and applies the overrides."""
    result: Any = object.__new__(_proxy_class(type(model)))  # type: ignore[arg-type]
    object.__setattr__(result, "__dict__", vars(model))
    object.__setattr__(result, "_clear_overrides", overrides)
    return result


@cache
def _proxy_class(cls: Any) -> Any:
    def read(self: Any, name: str) -> Any:
        get = partial(cls.__getattribute__, self, name)
        if (role := _ROLES.get(name)) is None:
            return get()
        overrides: Overrides = cls.__getattribute__(self, "_clear_overrides")
        if inspect.isroutine(inspect.getattr_static(cls, name, None)):
            return lambda *args, **kwargs: overrides.of(role, lambda: get()(*args, **kwargs))
        return overrides.of(role, get)

    members = {"__slots__": ("_clear_overrides",), "__module__": cls.__module__, "__getattribute__": read}
    return type(cls.__name__, (cls,), members)


def _apply(value: Any, overrides: Overrides, role: Role) -> Any:
    overrides.used.add(role)
    if isinstance(value, tuple):  # Mip-Splatting returns (scales, opacities)
        return (*value[:-1], _apply(value[-1], overrides, role))
    if role == "gate" and overrides.gate is not None:
        return value * overrides.gate.to(value).view(-1, *[1] * (value.dim() - 1))
    if role == "detail" and overrides.detail is not None:
        return value + sh0_offset(overrides.detail, value)
    return value


def host_output(
    result: Any,
    camera: Camera,
    params: Mapping[str, Tensor],
    gate: Float[Tensor, " N"] | None,
    drawings: Sequence[Drawing],
    *,
    centres: str,
    ranks_by_third_column: bool,
) -> HostOutput:
    """The result of a host's `render`: a dict with "render" [3 or more, H, W], whose first channels are RGB, "viewspace_points"
    [N, 2 or more] in NDC, "visibility_filter", a mask or indices, and "radii" of all Gaussians or of those. Those that the gate
    drops are marked as not visible in it.

    Args:
        camera: the camera of the photo at this resolution. drawings: see `AutogradShot`.
        centres: the key of the tensor whose gradient the densifier reads; where the result lacks it, "viewspace_points" is read.
        ranks_by_third_column: a third column of "viewspace_points" holds what the host ranks Gaussians by. Mip-Splatting splits
            as many by the absolute gradient as by the gradient, so that only its order counts.

    Raises:
        HostError: the result has another type, or the image another size.
    """
    names = ("render", "viewspace_points", "radii", "visibility_filter")
    if not isinstance(result, Mapping) or any(name not in result for name in names):
        found = ", ".join(map(str, result)) if isinstance(result, Mapping) else type(result).__name__
        raise HostError(f"render must return a dict with {', '.join(names)}, got {found}. Wrap a function that does.")
    image, radii = result["render"], result["radii"]
    screen = result[centres if centres in result else "viewspace_points"]
    if tuple(image.shape[1:]) != (camera.height, camera.width) or len(image) < 3:
        raise HostError(
            f"render must return an RGB image of {camera.width}x{camera.height} pixels, the size of its camera, got shape "
            f"{tuple(image.shape)}. Train at the resolution of the photos, and pass no other size to render."
        )
    marks = () if drawings or not image.requires_grad else (base_of(image),)
    passed, n = result["visibility_filter"], len(params["means"])
    if len(radii) == n:
        visible = radii > 0 if radii.dim() == 1 else (radii > 0).all(-1)
    else:  # those of the visible Gaussians alone, which the filter names
        visible = torch.zeros(n, dtype=torch.bool, device=radii.device)
        visible[passed.reshape(-1)] = True
    if gate is not None:
        kept = gate > 0
        if len(radii) == n:
            radii = radii * kept.view(-1, *[1] * (radii.dim() - 1)).to(radii)
        else:
            radii = radii[kept[passed.reshape(-1)]]
        visible = visible & kept
        passed = passed & kept if passed.dtype == torch.bool else passed[kept[passed.reshape(-1)]]
        result = {**result, "radii": radii, "visibility_filter": passed}
    width, height = camera.width, camera.height
    ranked = 2 if ranks_by_third_column and screen.shape[-1] == 3 else None
    slot = ScreenGradientSlot(screen, (width, height), (2 / width, 2 / height), ranked=ranked)
    means2d = project(params["means"].detach(), camera)
    shot = AutogradShot(image[:3].permute(1, 2, 0), means2d, visible, params, slot, drawings=drawings)
    return HostOutput(shot, result, marks)


def project(means: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, "N 2"]:
    """u_i = π(μ_i) in pixels; finite but meaningless for Gaussians behind the camera."""
    pose = camera.world_to_camera.to(means)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    z = z.clamp_min(torch.finfo(z.dtype).eps)
    return torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), -1)
