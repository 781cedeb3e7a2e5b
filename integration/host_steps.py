"""The steps of a host's optimizers: when a step of the host begins and ends, and additional steps on extra views.

Both scales of the training view and its extra views are rendered from the same parameters, because a host may have computed its
activations before it calls its renderer. The gradient of each extra view is therefore applied after the host has stepped.
"""

from __future__ import annotations

import inspect
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import count
from typing import Any, Final

import torch
from torch import Tensor
from torch.amp.grad_scaler import GradScaler

from clear_strategies.core.gradients import Grads
from clear_strategies.errors import HostError

_log = logging.getLogger(__name__)

_OF_SAM: Final = 2  # renderings of a view before the first step, by which steps by hand are told from those of SAM
_PATIENCE: Final = 10  # iterations with extra views, one after the other, of which none made a step, before a warning


class HostSteps:
    """Hooks on the host's optimizers. In a step of the host, each optimizer steps once, and then once for each extra view.

    Args:
        before: called before each of the host's optimizers steps.
        begins: called when a step of the host begins, with whether gradients have been merged since the last step.
        after: called after an optimizer has stepped, also on extra views.
        counts: `Attachment.counts`, to which this class adds.

    Attributes:
        by_hand: renderings that were merged before the first step; None: an optimizer has stepped.
    """

    def __init__(
        self, before: Callable[[], None], begins: Callable[[bool], None], after: Callable[[], None], counts: Counter[str]
    ) -> None:  # fmt: skip
        self._before, self._begins, self._after, self._counts = before, begins, after, counts
        self._hooks: list[Any] = []
        self._hooked: list[torch.optim.Optimizer] = []
        self._stepped: set[torch.optim.Optimizer] = set()  # in this step of the host
        self._has_merged = False  # since the last step
        self.by_hand: int | None = 0
        self._extra: list[Grads] = []
        self._rendered: Mapping[str, Tensor] = {}  # the leaves of `_extra`
        self._steps_on_extra = False  # an optimizer is stepping on an extra view
        self._has_stepped = False  # on the extra views of this iteration
        self._unused = 0  # consecutive iterations whose extra views no optimizer has stepped on

    def hook(self, optimizers: Sequence[torch.optim.Optimizer]) -> None:
        """Hook the steps of these optimizers, and remove the hooks of earlier ones. Only torch's optimizers have hooks."""
        if isinstance(optimizers, Mapping):
            raise TypeError("optimizers must be a sequence, got a dict: hook([*optimizers.values()]).")
        distinct = list(
            {id(o): o for o in map(_unwrapped, optimizers) if isinstance(o, torch.optim.Optimizer)}.values()
        )
        if list(map(id, distinct)) == list(map(id, self._hooked)):
            return
        for hook in self._hooks:
            hook.remove()
        self._hooked = distinct
        self._hooks = [
            *(o.register_step_pre_hook(self._before_one) for o in distinct),
            *(o.register_step_post_hook(lambda o, *_: self._after_one(o)) for o in distinct),
        ]  # fmt: skip

    def on_merge(self, *, first: bool) -> None:
        """Called when gradients were merged, the first of a rendering or more of it: the next step of any optimizer begins a step
        of the host.
        """
        self._stepped.clear()
        self._has_merged = True
        if self.by_hand is not None:
            self.by_hand += first

    @property
    def are_known(self) -> bool:
        """True if the host has optimizers whose steps can be seen. A loop that steps by hand has none but that of f_det, which it
        does not step.
        """
        return bool(self._hooked) and (self.by_hand is None or self.by_hand < _OF_SAM)

    @property
    def has_extra_views(self) -> bool:
        """True if the host's next step is followed by steps on extra views."""
        return bool(self._extra)

    @property
    def has_begun(self) -> bool:
        """True if an optimizer has stepped since the last merge."""
        return bool(self._stepped)

    @property
    def is_complete(self) -> bool:
        """True if all optimizers have stepped since the last merge."""
        return self._stepped.issuperset(self._hooked)

    def follow_by(self, params: Mapping[str, Tensor], gradients: Iterable[Grads]) -> None:
        """Set the gradients of this iteration's extra views. Warns if no optimizer has stepped on those of several iterations.

        Args:
            params: the host's leaves, by name.
            gradients: with respect to `params`; computed one by one, after the memory of the last iteration's is free.
        """
        if self._extra:
            self._unused = 0 if self._has_stepped else self._unused + 1
            if self._unused == _PATIENCE:
                _log.warning(
                    "extra views have no effect: they were rendered in %d iterations, and no optimizer that was passed stepped "
                    "on them. Pass those that the loop steps, and put new ones in the same dictionary.", _PATIENCE,
                )  # fmt: skip
        self._extra, self._has_stepped = [], False
        self._extra += gradients
        self._rendered = {name: p for name, p in params.items() if name != "detail"}

    def _before_one(self, optimizer: torch.optim.Optimizer, given: Sequence[Any], named: Mapping[str, Any]) -> Any:
        """Called before an optimizer steps, with the arguments of its `step`; returns those that it gets instead, None: the same.

        A closure may render. The step begins when it has returned.
        """
        if self._steps_on_extra:
            return None

        def of(x: Any) -> Any:
            return _called_once(x, optimizer, lambda: self._begin_one(optimizer)) if callable(x) else x

        if any(map(callable, (*given, *named.values()))):
            return tuple(map(of, given)), {name: of(x) for name, x in named.items()}
        self._begin_one(optimizer)
        return None

    def _begin_one(self, optimizer: torch.optim.Optimizer) -> None:
        self._before()
        if optimizer in self._stepped or self._stepped.isdisjoint(self._hooked):  # all may have been made anew
            self._stepped.clear()
        begins, self.by_hand = not self._stepped, None
        self._stepped.add(optimizer)
        if begins:
            has_merged, self._has_merged = self._has_merged, False
            self._begins(has_merged)

    def _after_one(self, optimizer: torch.optim.Optimizer) -> None:
        if self._steps_on_extra:
            return
        if self._extra:
            self._step_on_extra(optimizer)
        self._after()

    @torch.no_grad()
    def _step_on_extra(self, optimizer: torch.optim.Optimizer) -> None:
        """One step of this optimizer for each extra view; those of the optimizer of the positions are counted.

        An optimizer whose parameters were replaced after the views were rendered does not step (3DGS densifies before it steps).
        """
        stepped = [p for group in optimizer.param_groups for p in group["params"]]
        ids = {id(p) for p in stepped}
        params = {name: p for name, p in self._rendered.items() if id(p) in ids and p.requires_grad}
        if not params:
            return
        before, self._steps_on_extra = [p.grad for p in stepped], True
        scale = getattr(optimizer, "grad_scale", None)  # of an AMP gradient scaler, by which a fused optimizer divides
        if scale is not None:  # gradients of extra views are not scaled
            optimizer.grad_scale = None  # type: ignore[attr-defined]
        try:
            for grads in self._extra:
                for p in stepped:
                    p.grad = None
                for name, p in params.items():
                    p.grad = grads[name].to(p)
                _step(optimizer, next(iter(params.values())))
        finally:
            self._steps_on_extra = False
            if scale is not None:
                optimizer.grad_scale = scale  # type: ignore[attr-defined]
            for p, grad in zip(stepped, before, strict=True):
                p.grad = grad
        self._has_stepped = True
        if "means" in params:
            self._counts["extra views"] += len(self._extra)


def _unwrapped(optimizer: Any) -> Any:
    """The optimizer that steps, whose hooks run: those of Lightning and Accelerate hold it as `optimizer`."""
    inner = getattr(optimizer, "optimizer", None)
    return inner if isinstance(inner, torch.optim.Optimizer) else optimizer


def _called_once(
    closure: Callable[[], Any], optimizer: torch.optim.Optimizer, then: Callable[[], None]
) -> Callable[[], Any]:
    """The closure of a step, which calls `then` when it has returned.

    Raises (when called again):
        HostError: a step has one merged gradient.
    """
    calls = count(1)

    def once() -> Any:
        if next(calls) > 1:
            raise HostError(
                f"{type(optimizer).__name__} calls its closure several times in a step, but a step has one merged gradient. Take "
                "an optimizer that calls it once, as Adam does, or joint_loss in place of the loop's loss."
            )
        result = closure()
        then()
        return result

    return once


def stepping_scaler() -> GradScaler | None:
    """Torch's gradient scaler by whose `step` an optimizer steps now; None: there is none, or it is disabled."""
    frame = inspect.currentframe()
    while frame is not None and frame.f_code is not GradScaler.step.__code__:
        frame = frame.f_back
    scaler: GradScaler | None = None if frame is None else frame.f_locals["self"]
    return scaler if scaler is not None and scaler.is_enabled() else None


@cache
def _parameters(step: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(step).parameters


def _step(optimizer: torch.optim.Optimizer, rows: Tensor) -> None:
    """One step of all rows. An Adam of visible Gaussians takes a mask of them, 3DGS's SparseGaussianAdam also their number.

    Raises:
        HostError: it takes something else.
    """
    _, *parameters = _parameters(type(optimizer).step).values()  # behind the optimizer itself
    values: dict[str, Any] = {"visibility": torch.ones(len(rows), dtype=torch.bool, device=rows.device), "N": len(rows)}
    required = [p.name for p in parameters if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD]
    if unknown := [name for name in required if name not in values]:
        raise HostError(
            f"{type(optimizer).__name__}.step needs {', '.join(unknown)}, which is not known for an extra view. Leave out what "
            "adds views, e.g. --overrides '~strategies.pseudo_views'."
        )
    optimizer.step(**{p.name: values[p.name] for p in parameters if p.name in values})
