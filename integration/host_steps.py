"""The steps of a host's optimizers: when one of the host begins and ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from clear_strategies.errors import HostError
from integration.extra_steps import ExtraSteps
from integration.pending import current_pass


class HostSteps:
    """Hooks on the host's optimizers. One step of the host is each optimizer once.

    Args:
        extra: the steps on extra views, which follow those of each optimizer.
        is_waiting: whether a rendering waits for its backward pass.
        begins: called when a step of the host begins, with whether gradients were merged since the one before.
        after: called after an optimizer's own step.
    """

    def __init__(
        self, extra: ExtraSteps, *, is_waiting: Callable[[], bool], begins: Callable[[bool], None],
        after: Callable[[torch.optim.Optimizer], None],
    ) -> None:  # fmt: skip
        self._extra, self._is_waiting, self._begins, self._after = extra, is_waiting, begins, after
        self._hooks: list[Any] = []
        self._hooked: list[torch.optim.Optimizer] = []
        self._stepped: set[int] = set()  # the optimizers that have made this step
        self._has_merged = False  # since the last step

    def hook(self, optimizers: Sequence[torch.optim.Optimizer]) -> None:
        """Hook the steps of these, and no longer those of earlier ones. Others than torch's have no hooks."""
        distinct = list({id(o): o for o in optimizers if isinstance(o, torch.optim.Optimizer)}.values())
        if list(map(id, distinct)) == list(map(id, self._hooked)):
            return
        for hook in self._hooks:
            hook.remove()
        self._hooked = distinct
        self._stepped.clear()
        self._hooks = [
            *(o.register_step_pre_hook(lambda o, given, named: self._before_one(o, *given, *named.values())) for o in distinct),
            *(o.register_step_post_hook(lambda o, *_: None if self._extra.stepping else self._after(o)) for o in distinct),
        ]  # fmt: skip

    def on_merge(self) -> None:
        """Gradients were merged; the next step of any optimizer begins one of the host."""
        self._stepped.clear()
        self._has_merged = True

    @property
    def has_begun(self) -> bool:
        """Whether an optimizer has stepped since the last merge."""
        return bool(self._stepped)

    @property
    def is_complete(self) -> bool:
        """Whether all have."""
        return len(self._stepped) == len(self._hooked)

    def _before_one(self, optimizer: torch.optim.Optimizer, *given: Any) -> None:
        """
        Args:
            given: what `step` was called with.
        """
        if self._extra.stepping:
            return
        if any(callable(x) for x in given):
            raise HostError(
                "the host gives its optimizer a closure, which renders inside of step(), but the gradients are merged before. "
                "Render and call loss.backward(), then step() without a closure."
            )
        if current_pass() >= 0 and self._is_waiting():
            raise HostError(
                "the host steps inside of its backward pass, where the gradients of the views are not merged yet. Step after "
                "loss.backward() has returned, not in a hook of a gradient."
            )
        if id(optimizer) in self._stepped:
            self._stepped.clear()
        begins = not self._stepped
        self._stepped.add(id(optimizer))
        if begins:
            has_merged, self._has_merged = self._has_merged, False
            self._begins(has_merged)
