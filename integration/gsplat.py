"""CLEAR in a gsplat loop: wrap its `rasterization`, keep everything else.

    clear = attach(splats, optimizers, views, conductor, strategy=strategy, state=strategy_state)
    rasterization = clear.wrap(rasterization)

gsplat itself is not imported here but where its `Strategy` is subclassed (`ClearStrategy`, made on first use): its names,
shapes and orders are all that is needed, of 1.4 ([C, N] radii) as of 1.5 and later ([C, N, 2]).
"""

from __future__ import annotations

import functools
import inspect
import logging
import sys
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from types import TracebackType
from typing import Any, Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor
from clear_strategies.training.optim import LearningRates
from integration.attach import Attachment, Drawing, HostError, Which
from integration.bridge import AutogradShot
from integration.densify import Screen, warn_of_early_end, warn_of_unread_score
from rasterizers.geometry import SH_C0

_log = logging.getLogger(__name__)

ROWS: Final = "clear_rows"
"""In a gsplat strategy's `state`: which row each Gaussian had when the structure last changed. gsplat's operations gather
every tensor of the state together with the parameters, so this one becomes the map of the change."""

_ATTACHED: Final = "clear_attached"  # on a wrapped function: by whom
_SAME_POSE: Final = 1e-3  # largest difference between entries of two poses that are one camera's

Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


def attach(
    params: MutableMapping[str, Any] | torch.nn.ParameterDict,
    optimizers: MutableMapping[str, Any],
    views: Sequence[View],
    conductor: Conductor,
    *,
    strategy: Any = None,
    state: dict[str, Any] | None = None,
    detail: bool = True,
    names: Mapping[str, str] | None = None,
    seed: int = 0,
    loss_scale: Callable[[], float] | None = None,
    accumulation: int = 1,
) -> Attached:
    """Attach the strategies of a conductor to a gsplat-style loop.

    Args:
        params: gsplat's dict of leaves. optimizers: one for each of them.
        views: all training views; a rendering is recognised by its pose.
        strategy, state: gsplat's densifier and its running state: its threshold scales P2G's score, its state carries the
            map of every change. None: a loop without densification.
        detail: add the detail feature f_det as `params["detail"]`, with an Adam of its own; gsplat's densifiers clone, split
            and prune it like any other parameter.
        names: gsplat's name -> the host's, where they differ (nerfstudio: sh0 is features_dc).
        loss_scale, accumulation: see `Attachment`.

    Raises:
        ValueError: there is no view, or a parameter is missing.
    """
    return Attached(
        params, optimizers, views, conductor, strategy=strategy, state=state, detail=detail, names=names or {},
        seed=seed, loss_scale=loss_scale, accumulation=accumulation,
    )  # fmt: skip


class Attached:
    """The handle of `attach`: wraps renderings, and can be removed."""

    def __init__(
        self,
        params: MutableMapping[str, Any] | torch.nn.ParameterDict,
        optimizers: MutableMapping[str, Any],
        views: Sequence[View],
        conductor: Conductor,
        *,
        strategy: Any,
        state: dict[str, Any] | None,
        detail: bool,
        names: Mapping[str, str],
        seed: int,
        loss_scale: Callable[[], float] | None,
        accumulation: int,
    ) -> None:
        if not views:
            raise ValueError(
                "at least one view is needed: integration.views.view(...) makes one of an image and a camera."
            )
        self._params, self._names, self._views = params, {**dict.fromkeys(_GSPLAT), **names}, tuple(views)
        if missing := [own for own in map(self._own, _GSPLAT) if own not in params]:
            raise ValueError(f"params must hold {', '.join(map(self._own, _GSPLAT))}; {missing[0]} is missing.")
        means = params[self._own("means")]
        if detail and "detail" not in params:
            params["detail"] = torch.nn.Parameter(means.new_zeros(len(means), 3))
            rates = LearningRates()
            optimizers["detail"] = torch.optim.Adam([params["detail"]], lr=rates.detail, eps=rates.eps)
        self._state = state
        self._told: Tensor | None = None
        self._number()
        self._poses = torch.stack([view.lr.camera.world_to_camera for view in self._views]).to(means)
        self._said: set[str] = set()
        self._replaced: list[tuple[Any, str, Any]] = []
        self.attachment = Attachment(
            conductor, self.params, n_views=len(self._views), seed=seed, rows=None if state is None else self._changed,
            threshold=_threshold(strategy, conductor), loss_scale=loss_scale, accumulation=accumulation,
        )  # fmt: skip

    def params(self) -> dict[str, Tensor]:
        """The leaves of this moment, by gsplat's names."""
        found = {name: self._params[self._own(name)] for name in _GSPLAT}
        return found | ({"detail": self._params["detail"]} if "detail" in self._params else {})

    def wrap(self, rasterization: Rasterization) -> Rasterization:
        """The same function; training views are drawn at both scales, and whatever is drawn without gradients shows f_det."""
        if hasattr(rasterization, _ATTACHED):
            raise HostError("this rasterization is wrapped already; remove() the attachment that did it first.")
        signature = inspect.signature(rasterization)
        rest = [name for name, p in signature.parameters.items() if p.kind is p.VAR_KEYWORD]
        if missing := {"means", "opacities", "colors", "viewmats", "Ks", "width", "height"} - {*signature.parameters}:
            raise HostError(
                f"{rasterization} is not gsplat's rasterization: it names no {', '.join(sorted(missing))}. Wrap the function "
                "that takes them by name."
            )

        @functools.wraps(rasterization)
        def wrapped(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
            given = signature.bind(*args, **kwargs).arguments
            for name in rest:
                given |= given.pop(name, {})
            if self.attachment.removed:
                return rasterization(**given)
            if not torch.is_grad_enabled():
                return rasterization(**self._with_detail(given))
            view = self._recognise(given["viewmats"])
            if view is None:
                return rasterization(**given)

            def draw(which: Which, gate: Tensor | None) -> Drawing:
                return self._draw(rasterization, given, view, which, gate)

            return self.attachment.draw(view, draw)  # type: ignore[no-any-return]

        setattr(wrapped, _ATTACHED, self)
        return wrapped

    def replace_everywhere(self, rasterization: Rasterization) -> Rasterization:
        """Put the wrapped function wherever a loaded module holds the original by any name; `remove` puts it back."""
        wrapped = self.wrap(rasterization)
        for module in list(sys.modules.values()):
            for name, value in list(vars(module).items()) if hasattr(module, "__dict__") else ():
                if value is rasterization:
                    setattr(module, name, wrapped)
                    self._replaced.append((module, name, rasterization))
        return wrapped

    @torch.no_grad()
    def fold_detail(self) -> None:
        """Add f_det to sh0 and make it 0, for exports and viewers that know no detail feature."""
        if "detail" in self._params:
            sh0, detail = self._params[self._own("sh0")], self._params["detail"]
            sh0 += (detail / SH_C0).view_as(sh0)
            detail.zero_()

    def remove(self) -> None:
        """Leave the loop as it was; f_det stays where it is, see `fold_detail`."""
        self.attachment.remove()
        for module, name, original in self._replaced:
            setattr(module, name, original)
        self._replaced.clear()
        if self._state is not None:
            self._state.pop(ROWS, None)

    def __enter__(self) -> Attached:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.remove()

    def _own(self, name: str) -> str:
        return self._names.get(name) or name

    def _changed(self) -> Int[Tensor, " M"] | None:
        """parents[M] of the structure changes since it was last asked; None: there was none."""
        if self._state is None or self._state[ROWS] is self._told:
            return None
        rows: Tensor = self._state[ROWS]
        if bool((rows == 0).any()) and self.attachment.conductor.state_dict():
            raise HostError(
                "MCMC added Gaussians of which gsplat does not say where they come from, but "
                f"{', '.join(self.attachment.conductor.state_dict())} is remembered per Gaussian. Let MCMC end "
                "(refine_stop_iter) before SVS's anchor_start."
            )
        self._number()
        return (rows - 1).clamp_min(0)

    def _number(self) -> None:
        """Write down which row each Gaussian has: from 1, for gsplat's operations write 0 where they know no origin."""
        if self._state is not None:
            means = self._params[self._own("means")]
            self._told = self._state[ROWS] = torch.arange(1, len(means) + 1, device=means.device)

    def _recognise(self, viewmats: Float[Tensor, "*C 4 4"]) -> View | None:
        poses = viewmats.detach().reshape(-1, 4, 4)
        if len(poses) != 1:
            raise HostError(
                f"one view a step can be attached to, got {len(poses)}. Set batch_size=1, or call joint_loss for each view "
                "and average."
            )
        distance = (self._poses - poses).abs().amax((1, 2))
        nearest = int(distance.argmin())
        if float(distance[nearest]) > _SAME_POSE * max(1.0, float(poses.abs().max())):
            if "pose" not in self._said:
                _log.warning("a camera is none of the %d views; what it draws is left as it is.", len(self._views))
                self._said.add("pose")
            return None
        return self._views[nearest]

    def _draw(
        self, rasterization: Rasterization, given: Mapping[str, Any], view: View, which: Which, gate: Tensor | None
    ) -> Drawing:
        call = dict(given)
        if gate is not None:
            call["opacities"] = call["opacities"] * gate.to(call["opacities"])
        if which == "hr":
            call = self._with_detail(call)
            times = view.factor
            call |= {"Ks": _scaled(call["Ks"], times), "width": call["width"] * times, "height": call["height"] * times}
            call["render_mode"] = "RGB"
        expected = view.hr.camera if which == "hr" else view.lr.camera
        if (call["width"], call["height"]) != (expected.width, expected.height):
            raise HostError(
                f"{view.name} is drawn at {given['width']}x{given['height']}, but its photograph has "
                f"{view.lr.camera.width}x{view.lr.camera.height} pixels. Train at one resolution (nerfstudio: num_downscales=0)."
            )
        renders, alphas, info = rasterization(**call)
        size = call["width"], call["height"]
        packed = info["means2d"].dim() == 2
        rows = info["gaussian_ids"] if packed else None
        seen = _seen(info["radii"], packed)
        if gate is not None:  # who was left out has not been seen
            kept = (gate > 0)[rows] if rows is not None else gate > 0
            seen = seen & kept
            radii = info["radii"]
            info["radii"] = radii * kept.view(*kept.shape, *[1] * (radii.dim() - (1 if packed else 2))).to(radii)
        n = len(self._params[self._own("means")])
        means2d, visible = info["means2d"].detach().reshape(-1, 2), seen.reshape(-1)
        if rows is not None:
            means2d = means2d.new_zeros(n, 2).index_copy_(0, rows, means2d)
            visible = torch.zeros(n, dtype=torch.bool, device=rows.device).index_copy_(0, rows, visible)
        params = self.params() if which == "hr" else {k: v for k, v in self.params().items() if k != "detail"}
        image = renders[..., :3].reshape(size[1], size[0], 3)
        shot = AutogradShot(image, means2d, visible, params, Screen(info["means2d"], size, rows=rows))
        return Drawing(shot, renders, (renders, alphas, info))

    def _with_detail(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The same call, its colours those of f_base + f_det."""
        call = dict(given)
        if "detail" not in self._params or len(call["means"]) != len(self._params["detail"]):
            return call  # a part of the scene only: nobody says which
        detail, colors = self._params["detail"], call["colors"]
        if call.get("sh_degree") is None:
            call["colors"] = colors + detail
        else:
            call["colors"] = torch.cat((colors[..., :1, :] + detail[:, None] / SH_C0, colors[..., 1:, :]), -2)
        return call


_GSPLAT: Final = ("means", "quats", "scales", "opacities", "sh0", "shN")


def _threshold(strategy: Any, conductor: Conductor) -> float | None:
    """What the host's densifier holds ‖∇_u‖ against; says what of the strategies it does not heed."""
    threshold = getattr(strategy, "grow_grad2d", None)
    warn_of_unread_score(conductor, strategy, threshold)
    if not getattr(strategy, "asks_the_conductor", False):
        warn_of_early_end(conductor, getattr(strategy, "refine_stop_iter", None), "refine_stop_iter")
    return None if threshold is None else float(threshold)


def _seen(radii: Tensor, packed: bool) -> Bool[Tensor, ...]:
    """Drawn at all: radii are one number a Gaussian in gsplat 1.4 and two since."""
    two = radii.dim() == (2 if packed else 3)
    return (radii > 0).all(-1) if two else radii > 0


def _scaled(Ks: Float[Tensor, "*C 3 3"], times: int) -> Float[Tensor, "*C 3 3"]:
    return Ks * Ks.new_tensor([[times], [times], [1]])
