"""The view as strategies see it in work that may be recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from clear_strategies.core.view import Photo, View
from rasterizers.guards import unread
from rasterizers.recording import running


def guarded(view: View, *, over_changing: bool) -> View:
    """The view. In a recording its images alone may be read, which are copied before a replay.

    Args:
        over_changing: a strategy chooses the background, so that an image with transparency is another one in each replay.
    """
    if running() is None:
        return view

    def layer(x: Any, what: str) -> Any:
        return None if x is None else unread(x, f"the {what} of the view", ("shape", "dtype"))

    def photo(p: Photo) -> Photo:
        image = layer(p.image, "transparent image") if over_changing and p.transparency is not None else p.image
        camera = unread(p.camera, "the camera of the view", ("width", "height"))
        return replace(p, camera=camera, image=image, transparency=layer(p.transparency, "transparency"))

    lr, hr = photo(view.lr), photo(view.hr)
    return View(
        unread(view.name, "the name of the view"), lr, hr, hr.image if view.hr_is_photo else layer(view.truth, "truth"),
        unread(view.sr_source, "the sr_source of the view"), layer(view.depth, "depth"),
        layer(view.disagreement, "disagreement"), view.background,
    )  # fmt: skip
