"""CLEAR as a gsplat strategy: passed where a trainer expects `DefaultStrategy`, with no other line changed.

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
from integration.gsplat import Attached, attach


@dataclass
class ClearStrategy(DefaultStrategy):  # type: ignore[misc]
    """DefaultStrategy, driven by the strategies' score while they let the structure change.

    It derives from DefaultStrategy because trainers ask for that class by name. When the trainer initializes its state,
    CLEAR is attached to the parameters and `rasterization` is replaced in every module that holds it.

    Args:
        views, conductor: see `integration.gsplat.attach`. rasterization: the function that the trainer draws with.
        detail, seed: likewise.
    """

    views: Sequence[View] = ()
    conductor: Conductor | None = None
    rasterization: Callable[..., Any] = gsplat.rendering.rasterization
    detail: bool = True
    seed: int = 0
    attached: Attached | None = None

    asks_the_conductor: ClassVar[bool] = True
    """Densification ends where a strategy ends it, whatever refine_stop_iter says."""

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
        """Settings and names: trainers write their strategy into a configuration file, and photographs do not belong there."""
        settings = {field.name: getattr(self, field.name) for field in fields(DefaultStrategy)}
        strategies = self.conductor.strategies if self.conductor is not None else ()
        return {**settings, "views": [view.name for view in self.views], "strategies": [repr(s) for s in strategies]}

    def step_post_backward(
        self, params: Any, optimizers: Any, state: dict[str, Any], step: int, info: dict[str, Any], **keywords: Any
    ) -> None:
        """DefaultStrategy's, as long as every strategy lets the structure change."""
        attachment = self.attached.attachment if self.attached is not None else None
        if attachment is None or attachment.conductor.may_densify(attachment.t):
            super().step_post_backward(params, optimizers, state, step, info, **keywords)
