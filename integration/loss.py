"""For a loop that you edit: a loss whose gradient is the merged gradient of both scales.

The host keeps `loss.backward()` and everything after it: optimizer, gradient scaler, accumulation, densifier. For a loop
that must stay as it is, see attachment.py.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.deferred import Scalar
from clear_strategies.core.gradients import Grads, Shot
from clear_strategies.core.view import ExtraView, View
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import Update
from clear_strategies.strategies.base import overrides
from integration.announcement import Once
from integration.autograd_shot import AutogradShot, at_inputs, of_whole_image, require_named
from integration.densification import ScoreScaler, score_for_host
from integration.graph import Graph, edge_of, graph_of, require_apart, require_in_order, without_hooks
from integration.host import require_leaves
from integration.views import SAME_POSE, require_intrinsics
from rasterizers.interface import Camera
from rasterizers.modes import uncompiled

_log = logging.getLogger(__name__)
_ONCE: Final = WeakKeyDictionary[Conductor, Once]()


@uncompiled
def joint_loss(
    conductor: Conductor,
    params: Mapping[str, Tensor],
    lr: Shot,
    hr: Shot | None,
    view: View,
    t: int,
    scaler: ScoreScaler | None = None,
) -> tuple[Float[Tensor, ""], Update]:
    """λ_LR L_LR + λ_HR (L_base + λ_HF L_HF), whose gradient is the conductor's merged gradient, and the `Update`.

    Other leaves that the host trains get the gradient of λ_LR L_LR. Those that the rasterizer's inputs are computed from (a
    network, an embedding) also get that of HR after routing, if these inputs have the rows of `params` in their order, and are
    found in the graph or named by `AutogradShot.drawn`; otherwise a warning tells.

    Args:
        params: the leaves of the Gaussians that the host optimizes, by gsplat's names (and "detail", if the host has it).
        lr, hr: the renderings of this view at both scales, e.g. `AutogradShot`. t: the iteration, from 1.
        scaler: for hosts with a densifier; `backward()` then also writes the score where the densifier reads the screen
            gradient.

    Returns:
        The loss, and the `Update`: the step for `Conductor.after_step`, densification scores, conflict ratios.

    Raises:
        HostError: a parameter is no leaf, or a rendering names another tensor as it; a rendering has no gradients, or other
            intrinsics than its photo.
        ValueError: `params` and the renderings have different parameters, or one without a row for each Gaussian; f_det is drawn
            at LR, or not at HR; this package drew another training view than `view`; a strategy has not started.
    """
    values = {name: p.detach() for name, p in params.items()}
    _require_rows(values)
    require_leaves(params)
    _require_shots(params, lr=lr, hr=hr)
    of_lr, of_hr = graph_of(lr.image), graph_of(*(() if hr is None or hr.image.is_leaf else [hr.image]))
    _require_centres(lr=(lr, of_lr), hr=(hr, of_hr))
    _require_detail(params.get("detail"), of_lr, of_hr)
    _require_view(conductor, view, lr=of_lr, hr=of_hr)
    _require_started(conductor)
    with without_hooks([*of_lr.leaves, *of_hr.leaves]):
        if isinstance(lr, AutogradShot):
            lr = of_whole_image(lr)
            require_apart({} if lr.drawing else lr.drawn or {})
        if isinstance(hr, AutogradShot):
            require_apart(hr.drawn or {})
            warn = _ONCE.setdefault(conductor, Once(_log.warning))
            hr = replace(at_inputs(hr, warn), of_others=[])  # a shot may be used again
            require_in_order("hr", hr.inputs, hr.params)
        update = conductor.update(values, lr, hr, view, t)
        others = [*_others(params, lr, of_lr.leaves, update)]
    objective, λ = conductor.objective, conductor.objective.lambda_hr(t)
    if isinstance(hr, AutogradShot) and λ > 0:
        others += [(leaf, λ * g) for leaf, g in hr.of_others]
    losses = update.losses
    value = objective.lambda_lr * losses["lr"] + λ * (
        losses.get("base", 0.0) + objective.lambda_hf * losses.get("hf", 0.0)
    )
    merged = update.grads or Grads()
    if lost := [name for name, p in params.items() if p.requires_grad and name not in merged and name != "detail"]:
        raise ValueError(
            f"the renderings must name their parameters as params does; they have no gradient of {', '.join(lost)}."
        )
    trained = [(p, merged[name].to(p)) for name, p in params.items() if name in merged]
    leaves, gradients = zip(*trained, *others, strict=True)

    loss = with_gradients(value, gradients, *leaves)
    if scaler is not None and isinstance(lr, AutogradShot):
        slot, (own, ordinary) = lr.gradient_slot, (update.score, update.ordinary)
        score = None if own is None or ordinary is None else score_for_host(slot, own, ordinary, lr.visible, scaler)
        if score is not None:
            loss.register_hook(lambda loss_scale: slot.write(loss_scale * score))  # type: ignore[no-untyped-call]
    return loss, update


def extra_loss(conductor: Conductor, image: Float[Tensor, "h w 3"], extra: ExtraView, t: int) -> Float[Tensor, ""]:
    """λ_LR L_LR of an extra view, weighted by pixel.

        for extra in conductor.extra_views(t):
            optimizer.zero_grad()
            extra_loss(conductor, render(extra.photo.camera), extra, t).backward()
            optimizer.step()

    Args:
        image: rendered by the camera of `extra`, without a gate and without f_det.
    """
    losses = conductor.extra_loss(image, extra, t)
    return with_gradients(conductor.objective.lambda_lr * losses.values["lr"], [losses.cotangents[0]], image)


def with_gradients(value: Scalar, gradients: Sequence[Tensor], *tensors: Tensor) -> Float[Tensor, ""]:
    """A scalar that has these gradients with respect to the tensors; scaling it scales them."""
    scalar: Tensor = _WithGradients.apply(value, gradients, *tensors)  # type: ignore[no-untyped-call]
    return scalar


def _require_shots(params: Mapping[str, Tensor], **shots: Shot | None) -> None:
    for name, shot in shots.items():
        if shot is not None and not hasattr(shot, "vjp"):
            raise TypeError(
                f"{name} must be a Shot, e.g. AutogradShot(image, means2d, visible, params), got {type(shot).__name__}."
            )
        require_named(shot, params)
        if not isinstance(shot, AutogradShot) or shot.drawings or shot.image.requires_grad:
            continue
        if any(p.requires_grad for p in params.values()):
            raise HostError(
                f"{name} must be drawn with gradients: leave torch.no_grad(), and do not detach what is drawn."
            )


def _require_rows(params: Mapping[str, Tensor]) -> None:
    n = len(params["means"])
    for name, p in params.items():
        if p.shape[:1] != (n,):
            raise ValueError(
                f"params[{name!r}] must have a row for each of the {n:,} Gaussians, got {[*p.shape]}. Leave it out: what else "
                "the rendering depends on gets its gradient, too."
            )


def _require_centres(**drawn: tuple[Shot | None, Graph]) -> None:
    """Raise a HostError if an image is not computed from the tensor that should get its screen gradient, which would be 0."""
    for name, (shot, graph) in drawn.items():
        centres = shot.gradient_slot.tensor if isinstance(shot, AutogradShot) else None
        if centres is None or not centres.requires_grad or not graph.nodes or edge_of(centres).node in graph.nodes:
            continue
        raise HostError(
            f"{name} is not computed from its means2d {[*centres.shape]}, which would get no screen gradient. Pass what the "
            "rasterizer returned, no part or copy of it: of gsplat's, slot=ScreenGradientSlot(info['means2d'], (width, height)). "
            "Detach those of a rasterizer that returns none."
        )


def _require_detail(detail: Tensor | None, lr: Graph, hr: Graph) -> None:
    if detail is None or not detail.requires_grad:
        return
    if lr.reaches([detail]):
        raise ValueError("lr is drawn with f_det, which renders at HR alone show. Draw it without params['detail'].")
    if hr.nodes and not hr.reaches([detail]):
        raise ValueError(
            "hr is drawn without f_det, which would learn nothing. Draw it with an offset of the colours by params['detail']."
        )


def _require_view(conductor: Conductor, view: View, **graphs: Graph) -> None:
    """Raise a ValueError for a render by another view's camera. A pose of no view is accepted: the host may optimize poses."""

    def with_pose(camera: Camera, views: Sequence[View]) -> list[View]:
        if not views or camera.world_to_camera is views[0].lr.camera.world_to_camera:  # nothing is read from the device
            return [*views[:1]]
        poses = torch.stack([v.lr.camera.world_to_camera.detach() for v in views]).double().cpu()
        same = torch.isclose(camera.world_to_camera.detach().double().cpu(), poses, rtol=SAME_POSE, atol=SAME_POSE)
        return [v for v, is_same in zip(views, same.flatten(1).all(1).tolist(), strict=True) if is_same]

    for name, graph in graphs.items():
        for camera in (drawn.camera for drawn in graph.drawn.values()):
            if not with_pose(camera, [view]) and (drawn := with_pose(camera, conductor.views)):
                raise ValueError(
                    f"{name} must be drawn by the camera of its view {view.name}, got that of {drawn[0].name}. Pass its view."
                )
            photo = view.lr if name == "lr" else view.hr
            if (camera.width, camera.height) == (photo.camera.width, photo.camera.height):
                remedy = "Draw it by the camera of its view, whose K is that of the photo."
                drawn_by = camera.fx, camera.fy, camera.cx, camera.cy
                require_intrinsics(f"{name} of {view.name}", drawn_by, photo.camera, remedy)


def _require_started(conductor: Conductor) -> None:
    for s in conductor.strategies:
        if s.of_run.seed is None and (overrides(s, "on_fit_start") or overrides(s, "on_views")):
            raise ValueError(
                f"{type(s).__name__} has not started. Call conductor.on_fit_start(len(views), seed, views=views) before the loop."
            )


def _others(
    params: Mapping[str, Tensor], lr: Shot, leaves_of_lr: Sequence[Tensor], update: Update
) -> Iterator[tuple[Tensor, Tensor]]:  # fmt: skip
    """The other leaves of the LR rendering, each with its gradient of λ_LR L_LR."""
    slot = lr.gradient_slot.tensor if isinstance(lr, AutogradShot) else lr.means2d
    known = {id(slot), *map(id, params.values())}
    leaves = [leaf for leaf in leaves_of_lr if id(leaf) not in known]
    if leaves and update.cotangents_lr is not None:
        (cotangent,) = update.cotangents_lr
        found = torch.autograd.grad(lr.image, leaves, cotangent, retain_graph=True, allow_unused=True)
        yield from ((leaf, g) for leaf, g in zip(leaves, found, strict=True) if g is not None)


class _WithGradients(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Scalar, gradients: Sequence[Tensor], *tensors: Tensor) -> Tensor:
        ctx.gradients = gradients
        return torch.as_tensor(value, dtype=tensors[0].dtype, device=tensors[0].device)

    @staticmethod
    def backward(ctx: Any, scale: Tensor) -> Any:
        return None, None, *(g * scale for g in ctx.gradients)
