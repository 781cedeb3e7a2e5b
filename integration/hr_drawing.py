"""The gradients of HR and of extra views, which an iteration takes in addition to those of the host's own rendering. Either the
host's function draws them, or this package's rasterizer, whose work is recorded and replayed on CUDA.

A host gives its rasterizer activated tensors, which a `Drawable` holds. The work on them is rendering, losses, both cotangents in
one pass, evidence and routing. A host makes new tensors in each step, so a recording reads copies of them. The gradients then
reach the parameters through the host's own autograd graph, which stays live.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import Grads
from clear_strategies.core.step import Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import HrSide
from clear_strategies.merging.replay import LoggedReplay, logged_replays, why_not_recordable
from clear_strategies.strategies.base import stored
from integration.announcement import Once
from integration.autograd_shot import (
    AutogradShot,
    HostOutput,
    OfOthers,
    Target,
    at_inputs,
    every_number,
    of_whole_image,
    side_of_leaves,
    to_leaves,
)
from integration.host import Host
from integration.views import enlarged_mask
from rasterizers.differentiable import Drawing
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, is_recordable, over
from rasterizers.modes import in_full_precision
from rasterizers.replays import ReplayKey, shapes_of
from rasterizers.torch_internals import version

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Drawable:
    """A rendering that a host asks for, as the arguments of a rasterizer of this package.

    Args:
        inputs: in the host's graph; with f_det at HR.
        bands: the number of active bands of the colours.
        background: behind the picture.
        params: raw parameters by gsplat's names.
    """

    rasterizer: Rasterizer
    camera: Camera
    inputs: Inputs
    bands: int
    background: Float[Tensor, "1 3"]
    params: Mapping[str, Tensor]

    def compared_with(self, photo: Photo, **more: Any) -> _RenderInputs:
        """What is drawn, without its graph, and the photo that it is compared with."""
        drawn = self.inputs.drawn(self.bands)
        return _RenderInputs(*drawn, self.background, self.camera, photo.image, photo.shown, **more)


RenderAt = Callable[[Target, Float[Tensor, " N"] | None, View], HostOutput | Drawable]
"""Renders by the host's own renderer, with opacities multiplied by the gate; with f_det at HR, without it for any other target.
The view is that of the iteration, its SR image as large as the iteration needs. For a target other than LR, the function may
return a `Drawable`, which `HrDrawing` then renders.
"""


class _RenderInputs(NamedTuple):
    """All tensors that the work on one picture reads.

    Args:
        means, quats, scales, opacities, colors, rgb_offset: see `Inputs`.
        image, shown: of the photo that the picture is compared with.
        looked_up: see `Step.looked_up`; None for an extra view.
        weight: of the pixels of an extra view; None at HR.
        mask: by which the host multiplies the picture.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    rgb_offset: Tensor | None
    background: Float[Tensor, "1 3"]
    camera: Camera
    image: Tensor
    shown: Tensor | None
    looked_up: Tensor | None = None
    weight: Tensor | None = None
    mask: Float[Tensor, "H W 1"] | None = None

    def over(self, photo: Photo) -> Photo:
        """The photo with this image."""
        return Photo(photo.camera, self.image, self.shown)

    def shot(self, asked: Drawable) -> AutogradShot:
        rasterizer = asked.rasterizer
        if is_recordable(rasterizer):
            rasterizer = rasterizer.over_changing(self.background)
        else:
            red, green, blue = self.background[0].tolist()
            rasterizer = over(rasterizer, (red, green, blue))
        drawn = Inputs(self.means, self.quats, self.scales, self.opacities, self.colors, self.rgb_offset)
        r = rasterizer(drawn.splats(), self.camera)
        drawing = Drawing(r, rasterizer, asked.camera, asked.inputs, asked.bands)
        image = r.image if self.mask is None else r.image * self.mask
        return AutogradShot(image, r.means2d, r.visible, asked.params, drawings=(drawing,), mask=self.mask)


_Made = tuple[Any, dict[str, Number]]
_Work = Callable[[_RenderInputs], _Made]
"""Work on these inputs, or on a recording's copies of them. It returns its result, and numbers by name."""


class HrDrawing:
    """Renders HR and extra views, and takes their gradients.

    Args:
        device: of the Gaussians. On CUDA, the work on what this package draws is recorded and replayed.
        counts: `Attachment.counts`, to which this class adds.

    Attributes:
        is_scored: whether a strategy has a densification score that the host's densifier reads.
        replays: the recordings of this work; None: it is not recorded.
    """

    def __init__(self, conductor: Conductor, host: Host, device: torch.device, counts: Counter[str]) -> None:
        self._conductor, self._masks, self._counts = conductor, host.masks, counts
        self._sent: dict[str, tuple[Tensor, int, Tensor]] = {}  # masks: the host's, its version, and on the device
        self._loss_scale = host.loss_scale or (lambda: 1.0)
        self._log_once, self._warn_once = Once(_log.info), Once(_log.warning)
        self.is_scored = host.threshold is not None and conductor.owner("score") is not None
        self.replays = logged_replays(device, conductor, "the replay of HR")
        if self.replays is not None and (reason := next(why_not_recordable(conductor), None)) is not None:
            self.replays = None
            _log.info("HR is not replayed: %s.", reason)

    def wanted(self, t: int) -> bool:
        """Return True if HR takes part at t. No iteration is skipped while the host's densifier reads a score."""
        return self._conductor.wants_hr(t, scored=self.is_scored and self._conductor.may_densify(t))

    def hr(self, step: Step, gate: Float[Tensor, " N"] | None, render_at: RenderAt) -> tuple[HrSide, OfOthers]:
        """The HR side, by the raw parameters if HR takes part in the merge; and its gradients of other leaves."""
        self._counts["HR renders"] += 1
        conductor, view = self._conductor, step.view
        mask, asked = self._mask(view, step.params["means"]), render_at("hr", gate, view)
        drawn: Drawable | AutogradShot = (
            asked if isinstance(asked, Drawable) else at_inputs(asked.shot, self._warn_once)
        )
        if isinstance(drawn, Drawable):
            hr = self._own_hr(drawn, step, mask)
        else:
            shot = drawn if mask is None else replace(drawn, image=drawn.image * mask.to(drawn.image))
            if (n := len(shot.drawings)) > 1:
                self._counts["HR renders in parts"] += 1
                self._log_once(
                    "The host calls its rasterizer %d times for one rendering, so each of the two HR gradients needs a backward "
                    "pass of its own: with 46,000 Gaussians a step takes 1.4 times as long. Call it under torch.no_grad() for "
                    "what is only looked at, and outside of the wrapped function for what only the LR loss needs.", n,
                )  # fmt: skip
            apart = shot.drawing is not None or "detail" in shot.params
            hr = conductor.hr_gradients(shot, step, AutogradShot.gradients, apart=apart)
        if conductor.objective.lambda_hr(step.t) == 0:
            return hr, []
        edges, shared = (drawn.inputs.attributes(), ()) if isinstance(drawn, Drawable) else (drawn.edges, drawn.shared)
        return side_of_leaves(hr, edges, drawn.params, self._loss_scale(), shared)

    def extra_view(self, extra: ExtraView, view: View, t: int, render_at: RenderAt) -> Grads:
        """The gradient of an extra view, which is drawn without gate and f_det."""
        asked = render_at(extra.photo.camera, None, view)
        if isinstance(asked, Drawable):
            return self._own_extra_view(asked, extra, t)
        shot = of_whole_image(asked.shot)
        (g,) = shot.vjp(self._conductor.extra_loss(shot.image, extra, t).cotangents)
        return g

    def _mask(self, view: View, means: Tensor) -> Float[Tensor, "H W 1"] | None:
        """The host's mask of a view, at HR. It is sent only if the host has changed it, since to send waits for the device."""
        if (mask := self._masks.get(view.name)) is None:
            return None
        given, written, sent = self._sent.get(view.name, (None, 0, mask))
        if given is not mask or written != version(mask):
            sent = mask.to(means)
            self._sent[view.name] = mask, version(mask), sent
        return enlarged_mask(sent, view.factor)[..., None]

    @in_full_precision
    @torch.no_grad()
    def _own_hr(self, asked: Drawable, step: Step, mask: Float[Tensor, "H W 1"] | None) -> HrSide:
        """As `hr`, drawn by this package; by the drawn tensors."""
        conductor, t, view = self._conductor, step.t, step.view
        photo = view.hr.over(conductor.background(t), view.background)
        looked_up = conductor.looked_up(view)

        def work(inputs: _RenderInputs) -> tuple[HrSide, dict[str, Number]]:
            shown = view if inputs.image is photo.image else replace(view, hr=inputs.over(photo))
            shot = inputs.shot(asked)
            hr = conductor.hr_gradients(shot, Step(t, shown, looked_up=inputs.looked_up), AutogradShot.gradients)
            return hr, {**hr.losses}  # Eq. 9, 10, 12, 13

        inputs = asked.compared_with(photo, looked_up=looked_up, mask=mask)
        hr, losses = self._done(asked, inputs, t, ("hr", view.factor), work)
        seen = hr.step if self.replays is None else hr.step.copied()
        # `losses` is a copy: those of a recording are overwritten by the next replay.
        side: HrSide = replace(hr, step=replace(seen, t=t, view=view, params=step.params), losses=losses)
        return side

    @in_full_precision
    @torch.no_grad()
    def _own_extra_view(self, asked: Drawable, extra: ExtraView, t: int) -> Grads:
        """As `extra_view`, drawn by this package."""
        conductor = self._conductor
        photo = extra.photo.over(conductor.background(t), extra.background)

        def work(inputs: _RenderInputs) -> tuple[Grads, dict[str, Number]]:
            shot = inputs.shot(asked)
            shown = replace(extra, photo=inputs.over(photo), weight=cast(Tensor, inputs.weight))
            (g,) = shot.gradients(conductor.extra_loss(shot.image, shown, t).cotangents)
            return g, {}

        inputs = asked.compared_with(photo, weight=extra.weight)
        g, _ = self._done(asked, inputs, t, ("extra", extra.robust), work)
        found = every_number(to_leaves(g, asked.inputs.attributes(), asked.params)[0], asked.params)
        return Grads({name: x.clone() for name, x in found.items()})  # the next replay overwrites some of them

    def _done(self, asked: Drawable, inputs: _RenderInputs, t: int, constants: tuple[Any, ...], work: _Work) -> _Made:
        """Do the work, live or by a replay."""
        conductor, rasterizer = self._conductor, asked.rasterizer
        if self.replays is None or not is_recordable(rasterizer):
            return work(inputs)
        called = *conductor.comparing, conductor.owner("observe"), conductor.owner("route")
        state = [x.data_ptr() for s in called if s is not None for x in stored(s)]
        key = ReplayKey(n := len(inputs.means), tuple(state), shapes_of(inputs, n), (rasterizer, *constants))
        device = inputs.means.device

        def record() -> LoggedReplay[Any]:
            return LoggedReplay(
                device, conductor, lambda copies: work(_RenderInputs(*copies)), inputs, t,
                numbers_of=partial(rasterizer.numbers_of, device=device), calls=conductor.comparing,
            )  # fmt: skip

        return self.replays.do(key, t, inputs, live=lambda: work(inputs), record=record)
