"""The loop that stays as it is: CLEAR enters where the host draws, and leaves its mark on `.grad`.

One training iteration, seen from here:

    draw        zᵗ is sampled; Î_HR is drawn and heard; Î_LR is drawn with the same zᵗ and goes to the host
    backward    the host's own, of whatever loss it has: that is the authentic side. When it has ended, the `.grad` of
                every parameter becomes the merged gradient, and the tensor that the densifier reads holds the score
    and then    clipping, unscaling, any optimizer, densification: the host's own, in whichever order

The merge takes place at the end of `backward()` and not in a hook of the optimizer, so that gradient clipping sees what is
stepped by, optimizers that are no `torch.optim.Optimizer` are served too, and hosts that densify before they step
(Inria's) are no different from those that densify after (gsplat). Adapters for hosts: gsplat.py, nerfstudio.py, inria.py.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import Grads, conflict_columns, to_ndc
from clear_strategies.core.view import View
from clear_strategies.errors import ClearError
from clear_strategies.merging.conductor import Conductor, HrGradients, only
from integration.bridge import AutogradShot
from integration.densify import Scale, to_read

_log = logging.getLogger(__name__)

Which = Literal["lr", "hr"]


class HostError(ClearError, RuntimeError):
    """A host does what cannot be served; the message says what, and what to change there."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """One rendering as an adapter hands it in.

    Args:
        output: a tensor that the host's loss will be computed from (its gradient is the signal that backward began).
        returned: what the host's own render function returns.
    """

    shot: AutogradShot
    output: Tensor
    returned: Any


class Draw(Protocol):
    """Draws the view of this iteration once more."""

    def __call__(self, which: Which, gate: Float[Tensor, " N"] | None) -> Drawing:
        """At LR without f_det, or at HR with it; opacities times `gate`."""
        ...


class Attachment:
    """The strategies beside a host's loop.

    Args:
        params: the leaves that the host optimizes now, by gsplat's names (and "detail"); asked anew at each iteration, for
            densifiers replace them.
        rows: asked at each iteration: parents[M] if the structure has changed since (row i of every parameter now comes
            from row parents[i]), else None. No callable: the host cannot tell, and no strategy may remember anything per
            Gaussian while the number changes.
        threshold: the host's densification threshold on the mean ‖∇_u‖ in NDC units; None: nothing scales the score.
        loss_scale: what the host multiplies its loss by (`scaler.get_scale` of an AMP scaler).
        accumulation: backward passes to one optimizer step, each of 1/accumulation of the loss.
        n_views, seed: for the strategies' start.

    Attributes:
        t: the iteration that is under way, from 1. counts: what was done how often.
    """

    def __init__(
        self,
        conductor: Conductor,
        params: Callable[[], Mapping[str, Tensor]],
        *,
        n_views: int,
        seed: int = 0,
        rows: Callable[[], Int[Tensor, " M"] | None] | None = None,
        threshold: float | None = None,
        loss_scale: Callable[[], float] | None = None,
        accumulation: int = 1,
    ) -> None:
        if accumulation < 1:
            raise ValueError(f"accumulation must be at least 1 backward pass a step, got {accumulation}.")
        if not conductor.wants_lr:
            raise ValueError(
                "a host draws LR by itself, so the objective's lambda_lr must be > 0 and its lr_from lr, got "
                f"lambda_lr={conductor.objective.lambda_lr}, lr_from={conductor.objective.lr_from!r}."
            )
        self.conductor, self.accumulation = conductor, accumulation
        self.t = 1
        self.counts: Counter[str] = Counter()
        self._numbers: dict[str, Number] = {}
        self._params, self._rows, self._loss_scale = params, rows, loss_scale
        self._scale = None if threshold is None else Scale(threshold)
        self._n = len(params()["means"])
        self._passes = 0  # backward passes of this iteration
        self._waiting: tuple[Drawing, HrGradients[Grads] | None] | None = None  # drawn, not yet gone backward through
        self._before: dict[str, Tensor] = {}  # .grad when backward began
        self.removed = False
        conductor.on_fit_start(n_views, seed, params()["means"].device)
        if not conductor.strategies:
            _log.info("no strategy is attached: both losses are summed, as in the paper's baseline.")

    def draw(self, view: View, draw: Draw) -> Any:
        """Draw both scales of a training view; returns what the host's render function would have."""
        if self.removed:
            return draw("lr", None).returned
        self._advance()
        conductor, t = self.conductor, self.t
        z = conductor.gate(t, self._n)
        if z is not None:
            z = z.to(self._params()["means"])
        hr_grads = None
        if conductor.wants_hr(t):
            self.counts["HR renders"] += 1
            hr_grads = conductor.hr_gradients(draw("hr", z).shot, view)
        drawing = draw("lr", z)
        if drawing.output.requires_grad:
            self._waiting = drawing, hr_grads
            drawing.output.register_hook(self._begin)  # type: ignore[no-untyped-call]
        self.counts["LR renders"] += 1
        return drawing.returned

    @property
    def log(self) -> dict[str, float]:
        """Numbers of the last iteration; on a device, looking waits for them."""
        return deferred.resolve([self._numbers])[0]

    def remove(self) -> None:
        """Leave the host as it was; drawings that are still under way go to it unmerged."""
        self.removed, self._waiting = True, None

    def _advance(self) -> None:
        """What the last step calls for, now that the host has made it and changed its structure if it wanted to."""
        params = self._params()
        self._follow(len(params["means"]))
        if self._passes >= self.accumulation:
            self.conductor.after_step({name: p.detach() for name, p in params.items()}, self.t)
            self.t += 1
            self._passes = 0

    def _follow(self, n: int) -> None:
        """Have the strategies' own rows follow the Gaussians."""
        parents = None if self._rows is None else self._rows()
        if parents is None and n == self._n:
            return
        remembered = ", ".join(self.conductor.state_dict())
        if parents is not None:
            self.conductor.on_resize(parents)
        elif remembered:
            self.conductor.on_resize(
                torch.zeros(n, dtype=torch.long)
            )  # SVS knows the better sentence: whose anchor, when
            raise HostError(
                f"the number of Gaussians changed from {self._n:,} to {n:,}, and nothing tells which came from which; but "
                f"{remembered} is remembered per Gaussian. End densification first, or give the host's state."
            )
        self.counts["structure changes"] += 1
        self._n = n

    def _begin(self, _: Tensor) -> None:
        """The host's backward pass has reached Î_LR, and no parameter yet."""
        if self._waiting is None:
            return
        self._before = {name: p.grad.clone() for name, p in self._params().items() if p.grad is not None}
        screen = self._waiting[0].shot.kept.tensor
        caught: list[Tensor] = []
        if screen.requires_grad:
            hook = screen.register_hook(caught.append)  # type: ignore[no-untyped-call]

        def end() -> None:
            if screen.requires_grad:
                hook.remove()
            self._end(caught[0] if caught else None)

        torch.autograd.Variable._execution_engine.queue_callback(end)

    @torch.no_grad()
    def _end(self, screen: Tensor | None) -> None:
        """The host's backward pass has ended: make its gradients the merged ones."""
        if self._waiting is None:
            return
        (drawing, hr_grads), self._waiting = self._waiting, None
        times = (self._loss_scale() if self._loss_scale is not None else 1.0) / self.accumulation
        moved = {name: p for name, p in self._params().items() if p.grad is not None or name == "detail"}
        g_lr = Grads({name: self._own(name, p) * (1 / times) for name, p in moved.items() if p.grad is not None})
        values = {name: p.detach() for name, p in moved.items()}
        merged = self.conductor.merge(values, g_lr, None if hr_grads is None else only(hr_grads, moved), self.t)
        g = merged.grads
        for (
            name,
            p,
        ) in moved.items():  # f_det has a gradient of 0 while HR is silent, so that its Adam counts every step
            total = g[name] * times if name in g else torch.zeros_like(p)
            p.grad = (total + self._before[name] if name in self._before else total).to(p)
        if screen is not None:
            self._densify(drawing.shot, screen / times, hr_grads, times)
        self._before = {}
        self._passes += 1
        self.counts["merged"] += 1
        λ = self.conductor.objective.lambda_hr(self.t)
        losses = {} if hr_grads is None else hr_grads.losses
        self._numbers = {"t": float(self.t), "lambda_hr": λ, **losses, **self.conductor.logs()}
        self._numbers |= conflict_columns(merged.conflict)

    def _own(self, name: str, p: Tensor) -> Tensor:
        """This pass's part of `.grad`."""
        if p.grad is None or p.grad.is_sparse:
            raise HostError(
                f"{name}.grad is sparse; gradients of all Gaussians are merged. In gsplat: rasterization(sparse_grad=False)."
            )
        return p.grad - self._before[name] if name in self._before else p.grad

    def _densify(self, shot: AutogradShot, gradient: Tensor, hr_grads: HrGradients[Grads] | None, times: float) -> None:
        """Leave the score where the host's densifier reads ∇_u, if it does."""
        kept = shot.kept
        held = kept.tensor.is_leaf or kept.tensor.retains_grad
        if hr_grads is None or not held or kept.tensor.grad is None:
            return
        score, ordinary = self.conductor.scores(to_ndc(kept.gradient(gradient, self._n), kept.size), hr_grads, self.t)
        read = to_read(kept, score, ordinary, shot.visible, self._scale, times)
        if read is not None:
            kept.hand_over(times * read)
        self.counts["scores handed over"] += score is not ordinary
