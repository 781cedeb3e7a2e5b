"""A host's model, camera and picture as an adapter needs them, where `render` takes the model whole (Inria's 3DGS and what
descends from it): the model with gated opacities and f_det in its colours, the camera at HR, the result as a `Drawing`.
"""

from __future__ import annotations

import copy
import inspect
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor
from integration.attach import Drawing, HostError, Which
from integration.bridge import AutogradShot
from integration.densify import Screen
from integration.lineage import Detail
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

Role = Literal["gate", "detail"]

# What cameras call what they measure in pixels; one host has some of them, another others.
_IN_PIXELS: Final = (
    "image_width", "image_height", "width", "height", "focal_x", "focal_y", "fx", "fy", "cx", "cy",
)  # fmt: skip


@dataclass(slots=True, eq=False)
class Shown:
    """What a model is seen with.

    Args:
        gate: z, a factor of every opacity. detail: f_det, an offset of every colour. None: as they are.
        read: which of them the host has looked at. busy: inside a getter that other getters may call.
    """

    gate: Float[Tensor, " N"] | None = None
    detail: Float[Tensor, "N 3"] | None = None
    read: set[Role] = field(default_factory=set)
    busy: set[Role] = field(default_factory=set)


def seen(model: Any, shown: Shown, roles: tuple[tuple[str, Role], ...]) -> Any:
    """The same model, sharing all it has, but for what is `shown`.

    Args:
        roles: which of its getters, methods and attributes give opacities (or a pair that ends with them), and which the
            constant band of its colours; those that it does not have are passed over.
    """
    view: Any = object.__new__(_kind(type(model), roles))  # type: ignore[arg-type]
    object.__setattr__(view, "__dict__", vars(model))
    object.__setattr__(view, "_clear_shown", shown)
    return view


@cache
def _kind(cls: type, roles: tuple[tuple[str, Role], ...]) -> type:
    members: dict[str, Any] = {"__slots__": ("_clear_shown",), "__module__": cls.__module__}
    for name, role in roles:
        members |= {name: _member(inspect.getattr_static(cls, name, None), name, role)}
    return type(cls.__name__, (cls,), members)


def _member(original: Any, name: str, role: Role) -> Any:
    """A getter, method or plain attribute that gives what `original` gives, changed once."""

    def changed(self: Any, get: Callable[[], Any]) -> Any:
        shown: Shown = self._clear_shown
        if role in shown.busy:
            return get()
        shown.busy.add(role)
        try:
            return _changed(get(), shown, role)
        finally:
            shown.busy.discard(role)

    if callable(original):
        return lambda self, *args, **kwargs: changed(self, lambda: original(self, *args, **kwargs))
    if isinstance(original, property):
        return property(lambda self: changed(self, lambda: original.__get__(self)))
    return property(lambda self: changed(self, lambda: _attribute(self, name)))


def _attribute(model: Any, name: str) -> Any:
    try:
        return vars(model)[name]
    except KeyError:
        raise AttributeError(f"{type(model).__name__} has no {name}") from None


def _changed(value: Any, shown: Shown, role: Role) -> Any:
    shown.read.add(role)
    if isinstance(value, tuple):  # Mip-Splatting's (scales, opacities)
        return (*value[:-1], _changed(value[-1], shown, role))
    if role == "gate" and shown.gate is not None:
        return value * shown.gate.to(value).view(-1, *[1] * (value.dim() - 1))
    if role == "detail" and shown.detail is not None:
        return value + (shown.detail / SH_C0).view_as(value)
    return value


class Eye:
    """Looks at a model through a host's render function, at either scale; says once what the host does not look at.

    Args:
        leaves: the host's parameters of this moment, by gsplat's names.
        detail: f_det, shown at HR and where nothing is trained; None: there is none.
    """

    def __init__(
        self,
        model: Any,
        roles: tuple[tuple[str, Role], ...],
        leaves: Callable[[], Mapping[str, Tensor]],
        detail: Detail | None,
        conductor: Conductor,
    ) -> None:
        self._model, self._roles, self._leaves, self._detail = model, roles, leaves, detail
        scoring = conductor.owner("score")
        self._scoring = None if scoring is None else type(scoring).__name__
        self._said: set[str] = set()

    def params(self) -> dict[str, Tensor]:
        """The leaves of this moment, f_det among them."""
        detail = {} if self._detail is None else {"detail": self._detail.value}
        return {**self._leaves(), **detail}

    def whole(self) -> Any:
        """The model as one looks at it: f = base + det, nobody left out."""
        return seen(self._model, Shown(detail=None if self._detail is None else self._detail.value), self._roles)

    def draw(
        self,
        render: Callable[[Any], Any],
        of: View,
        which: Which,
        gate: Float[Tensor, " N"] | None,
        unit: Callable[[Mapping[str, Any]], tuple[float, float] | None] = lambda result: None,
    ) -> Drawing:
        """Draw the view at LR without f_det, or at HR with it.

        Args:
            render: the host's, of a model alone. unit: see `drawing`, by the result.
        """
        shown = Shown(gate, self._detail.value if which == "hr" and self._detail is not None else None)
        result = render(seen(self._model, shown, self._roles))
        if shown.gate is not None and "gate" not in shown.read:
            self.say("render reads none of the model's opacity getters: dropout has no effect.")
        if shown.detail is not None and "detail" not in shown.read:
            self.say("render reads no constant colours of the model: the detail feature has no effect.")
        params = self.params() if which == "hr" else self._leaves()
        trained = {name: p for name, p in params.items() if p.requires_grad}
        drawn = drawing(result, (of.hr if which == "hr" else of.lr).camera, trained, shown, unit)
        if drawn.shot.kept.tensor.shape[-1] == 4 and self._scoring is not None:
            self.say(
                "viewspace_points have 4 columns: absolute gradients stay those of the LR image, the densification score of "
                "%s goes to the first two columns alone.", self._scoring,
            )  # fmt: skip
        return drawn

    def say(self, message: str, *values: Any) -> None:
        """Warn, once."""
        if message not in self._said:
            _log.warning(message, *values)
            self._said.add(message)


def drawing(
    result: Any,
    camera: Camera,
    params: Mapping[str, Tensor],
    shown: Shown,
    unit: Callable[[Mapping[str, Any]], tuple[float, float] | None],
) -> Drawing:
    """The result of a host's `render`: a dict with "render" [3, H, W], "viewspace_points" [N, 2 or more], "radii" and
    "visibility_filter" [N]. Who is left out has not been seen, and the dict says so.

    Args:
        camera: that of the photograph.
        unit: of a result, what makes a gradient of its "viewspace_points" one in 1/pixel; None: they are in NDC.

    Raises:
        HostError: something else was returned, or of another size.
    """
    names = ("render", "viewspace_points", "radii", "visibility_filter")
    if not isinstance(result, Mapping) or any(name not in result for name in names):
        found = ", ".join(map(str, result)) if isinstance(result, Mapping) else type(result).__name__
        raise HostError(f"render must return a dict with {', '.join(names)}, got {found}. Wrap a function that does.")
    image, screen, radii = (result[name] for name in names[:3])
    if tuple(image.shape) != (3, camera.height, camera.width):
        raise HostError(
            f"a picture of {camera.width}x{camera.height} pixels was expected, render gave {tuple(image.shape)}. Train at "
            "one resolution, that of the photographs."
        )
    visible = radii > 0 if radii.dim() == 1 else (radii > 0).all(-1)
    if shown.gate is not None:
        kept = shown.gate > 0
        visible = visible & kept
        passed = result["visibility_filter"]
        result = {
            **result,
            "radii": radii * kept.view(-1, *[1] * (radii.dim() - 1)).to(radii),
            "visibility_filter": passed & kept if passed.dtype == torch.bool else passed[kept[passed.reshape(-1)]],
        }
    size = camera.width, camera.height
    kept_screen = Screen(screen, size, unit(result) or (2 / size[0], 2 / size[1]))
    u = centres(params["means"].detach(), camera)
    return Drawing(AutogradShot(image.permute(1, 2, 0), u, visible, params, kept_screen), image, result)


def centres(means: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, "N 2"]:
    """u_i = π(μ_i), pixels; of Gaussians behind the camera some finite number."""
    pose = camera.world_to_camera.to(means)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    z = z.clamp_min(torch.finfo(z.dtype).eps)
    return torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), -1)


def enlarged(camera: Any, factor: int) -> Any:
    """The same camera on a pixel grid `factor` times as fine; fields of view and projections stay."""
    larger = copy.copy(camera)
    for name in _IN_PIXELS:
        if hasattr(camera, name):
            setattr(larger, name, getattr(camera, name) * factor)
    return larger
