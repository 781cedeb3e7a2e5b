"""CLEAR in a gsplat loop: wrap its `rasterization`, and keep everything else.

    clear = attach(splats, optimizers, views, conductor, strategy=strategy, state=strategy_state)
    rasterization = clear.wrap(rasterization)

`ClearStrategy` takes the place of gsplat's `DefaultStrategy` instead. gsplat is imported for `ClearStrategy` only. The names,
shapes and order of calls that `attach` relies on are those of gsplat 1.4 (radii [C, N]) and 1.5 (radii [C, N, 2]).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from integration.gsplat.attached import ROWS, Attached, attach

if TYPE_CHECKING:
    from integration.gsplat.strategy import ClearStrategy

__all__ = ["ROWS", "Attached", "ClearStrategy", "attach"]


def __getattr__(name: str) -> Any:
    if name == "ClearStrategy":
        from integration.gsplat.strategy import ClearStrategy

        return ClearStrategy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
