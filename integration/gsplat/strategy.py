"""CLEAR as a gsplat strategy: passed where a trainer expects `DefaultStrategy`, without any other change.

cfg.strategy = ClearStrategy(views=views, conductor=conductor("clear", iterations=30_000))
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import gsplat.rendering
from gsplat.strategy import DefaultStrategy

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor
from integration.gsplat.attached import Attached, attach


@dataclass
class ClearStrategy(DefaultStrategy):  # type: ignore[misc]
    """DefaultStrategy that attaches CLEAR, densifies by its score, and stops when a strategy ends densification.

    It derives from DefaultStrategy because trainers test for that class. When the trainer initializes the strategy's state,
    CLEAR is attached to the parameters, and `rasterization` is replaced in every module that holds it.

    Args:
        views, conductor, detail, seed: see `integration.gsplat.attach`.
        rasterization: the function that the trainer renders with.
    """

    views: Sequence[View] = ()
    conductor: Conductor | None = None
    rasterization: Callable[..., Any] = gsplat.rendering.rasterization
    detail: bool = True
    seed: int = 0
    attached: Attached | None = None

    follows_may_densify: ClassVar[bool] = True
    """Densification ends when a strategy ends it, whatever refine_stop_iter is."""

    def check_sanity(self, params: Any, optimizers: Any) -> None:
        super().check_sanity(params, optimizers)
        self._trained = params, optimizers

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        state: dict[str, Any] = super().initialize_state(scene_scale)
        if not hasattr(self, "_trained"):
            raise ValueError(
                "call strategy.check_sanity(params, optimizers) before initialize_state, as gsplat's trainers do."
            )
        self.attached = attach(
            *self._trained, self.views, self.conductor or Conductor(), strategy=self, state=state, detail=self.detail,
            seed=self.seed,
        )  # fmt: skip
        self.attached.replace_everywhere(self.rasterization)
        return state

    def __getstate__(self) -> dict[str, Any]:
        """Settings and names only: trainers write their strategy to a configuration file, which must not hold photos."""
        settings = {field.name: getattr(self, field.name) for field in fields(DefaultStrategy)}
        strategies = self.conductor.strategies if self.conductor is not None else ()
        return {**settings, "views": [view.name for view in self.views], "strategies": [repr(s) for s in strategies]}

    def step_post_backward(
        self, params: Any, optimizers: Any, state: dict[str, Any], step: int, info: dict[str, Any], **keywords: Any
    ) -> None:
        """DefaultStrategy's step, as long as every strategy allows densification."""
        attachment = self.attached.attachment if self.attached is not None else None
        if attachment is None or attachment.conductor.may_densify(attachment.t):
            super().step_post_backward(params, optimizers, state, step, info, **keywords)
