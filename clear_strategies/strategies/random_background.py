"""RandomBackground: each iteration is rendered over another colour, so that surfaces become opaque.

Over a black background, a dark surface can be transparent, since the background is as dark. From another camera, something else
shows through it. Over a colour that changes in each iteration, only an opaque surface matches its photo.

With many views, which see a surface from several sides, the changing colour is noise that costs more than it gains. This does not
hold for photos that are transparent around an object: they are composited over the same colour, and only Gaussians of the object
match all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch

from clear_strategies.core.seeds import generator_at
from clear_strategies.core.view import View
from clear_strategies.geometry.photos import cut_out, is_background
from clear_strategies.schedules import milestone
from clear_strategies.strategies.base import Strategy
from rasterizers.interface import Color

_FEW_VIEWS: Final = 5  # more views keep the background of the scene
_LONG_RUN: Final = 1_350  # iterations over other colours; with fewer, surfaces have no time to become opaque


@dataclass(frozen=True)
class RandomBackground(Strategy):
    """A background of a random colour in each iteration, for at most five photos that show surfaces everywhere, and for any
    number of photos of an object whose background is transparent.

    If an object's background is plain but not transparent, it stays, since the photos do show what is behind the object.

    Args:
        until: the iteration after which the background is the scene's own, as in evaluation. If it is less than 1,350, the
            background never changes: opacities start low, and a short run that must first raise them would lose quality.
    """

    until: int = milestone(9_000)

    def on_fit_start(self, n_views: int, seed: int) -> None:
        super().on_fit_start(n_views, seed)
        self.cache["reason"] = self._reason_to_keep(n_views)

    def summary(self) -> str | None:
        reason: str = self.cache.get("reason", "")
        return f"none, {reason}" if reason else f"another colour in each of the first {self.until:,} iterations"

    def on_views(self, views: Sequence[View]) -> None:
        if views:  # else the answer for their number stays
            self.cache["reason"] = self._reason_to_keep(len(views), views)

    def _reason_to_keep(self, n_views: int, views: Sequence[View] = ()) -> str:
        """Why the background stays; empty if it changes."""
        if self.until < _LONG_RUN:
            return f"because the run has fewer than {_LONG_RUN:,} iterations for it"
        if any(view.lr.shown is not None for view in views):
            return "because masks hide a part of the photos"
        if views and cut_out((view.lr.to("cpu") for view in views), views[0].background):
            opaque = "because the photos show an object before a plain background that is not transparent"
            return "" if all(map(_transparent, views)) else opaque
        return f"because there are more than {_FEW_VIEWS} training views" if n_views > _FEW_VIEWS else ""

    def background(self, t: int) -> Color | None:
        """RGB, uniform in [0, 1]: a function of (seed, t)."""
        if t > self.until or self.cache.get("reason"):
            return None
        r, g, b = torch.rand(3, generator=generator_at(self.seed, t), device="cpu").tolist()
        return r, g, b


def _transparent(view: View) -> bool:
    """Return True if the photo is transparent where it has the colour of the background."""
    if view.lr.transparency is None:
        return False
    behind = is_background(view.lr.image, view.background)
    return float(view.lr.transparency[behind].sum()) >= 0.5 * float(behind.sum())
