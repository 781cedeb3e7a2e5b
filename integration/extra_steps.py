"""Steps of a host's optimizers on extra views: pictures that strategies want the field to match besides the training view."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Final

import torch
from torch import Tensor

from clear_strategies.core.gradients import Grads

_log = logging.getLogger(__name__)

_PATIENCE: Final = 10  # iterations with extra views, one after the other, of which none made a step, before a warning


class ExtraSteps:
    """Stores the gradient of each extra view before the host's step, and steps on it after that.

    Both scales of the training view and its extra views are rendered from the same parameters, because a host may have
    computed its activations before it calls its renderer.

    Attributes:
        stepping: whether a step on an extra view is under way, so that hooks on the host's steps do not count it.
    """

    def __init__(self) -> None:
        self._gradients: Sequence[Grads] = ()
        self._rendered: Mapping[str, Tensor] = {}  # what they are gradients of
        self.stepping = False
        self._has_stepped, self._unused = False, 0  # on those of this iteration; iterations since the last that did

    def take(self, params: Mapping[str, Tensor], gradients: Sequence[Grads]) -> None:
        """Those of the extra views of this iteration, with respect to these leaves of the host."""
        self._gradients = gradients
        self._rendered = {name: p for name, p in params.items() if name != "detail"}

    @torch.no_grad()
    def step(self, optimizer: torch.optim.Optimizer) -> int:
        """One step of this optimizer for each extra view; returns how many steps the positions made.

        An optimizer whose parameters were replaced after the views were rendered makes none (3DGS densifies before it steps).
        """
        if not self._gradients:
            return 0
        stepped = [p for group in optimizer.param_groups for p in group["params"]]
        ids = {id(p) for p in stepped}
        params = {name: p for name, p in self._rendered.items() if id(p) in ids and p.requires_grad}
        if not params:
            return 0
        before, self.stepping = [p.grad for p in stepped], True
        scale = getattr(optimizer, "grad_scale", None)  # an AMP gradient scaler's, which a fused optimizer divides by
        if scale is not None:  # gradients of extra views are not scaled
            optimizer.grad_scale = None  # type: ignore[attr-defined]
        try:
            for grads in self._gradients:
                for p in stepped:
                    p.grad = None
                for name, p in params.items():
                    p.grad = grads[name].to(p)
                _step(optimizer, next(iter(params.values())))
        finally:
            self.stepping = False
            if scale is not None:
                optimizer.grad_scale = scale  # type: ignore[attr-defined]
            for p, grad in zip(stepped, before, strict=True):
                p.grad = grad
        self._has_stepped = True
        return len(self._gradients) if "means" in params else 0

    def forget(self) -> None:
        """Before an iteration: drop the gradients of the one before, stepped on or not. Warn where they no longer are."""
        if self._gradients:
            self._unused = 0 if self._has_stepped else self._unused + 1
            if self._unused == _PATIENCE:
                _log.warning(
                    "extra views have no effect: they were rendered in %d iterations, and no optimizer that was passed stepped "
                    "on them. Pass those that the loop steps, and put new ones in the same dictionary.", _PATIENCE,
                )  # fmt: skip
        self._gradients, self._rendered, self._has_stepped = (), {}, False


@cache
def _parameters(step: Callable[..., Any]) -> frozenset[str]:
    return frozenset(inspect.signature(step).parameters)


def _step(optimizer: torch.optim.Optimizer, rows: Tensor) -> None:
    """One step of all rows. An Adam of visible Gaussians takes which move, 3DGS's SparseGaussianAdam also how many there are."""
    parameters = _parameters(type(optimizer).step)
    known: dict[str, Any] = {}
    if "visibility" in parameters:
        known["visibility"] = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
    if "N" in parameters:
        known["N"] = len(rows)
    optimizer.step(**known)
