"""The viewer of a run that trains: nerfview draws its pictures between two iterations."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Final

from clear_strategies.errors import SettingError
from clear_strategies.viewing.cameras import SavedCamera
from clear_strategies.viewing.look import Painter

_PATIENCE: Final = 0.02  # seconds between looks at the button while the run is paused
_TURN: Final = 0.002  # seconds that the lock is free after an iteration, so that a thread that waits for it gets it


def require_viewer() -> None:
    """Raise a SettingError where one of the viewer's libraries is not installed."""
    if missing := [name for name in ("viser", "nerfview", "splines") if find_spec(name) is None]:
        raise SettingError(f"the viewer needs {' and '.join(missing)}: pip install 'clear-strategies[view]'.")


@contextmanager
def watched(
    painter: Painter, cameras: Sequence[SavedCamera], title: str, report: Callable[[str], None]
) -> Iterator[Callable[[int], None]]:
    """A viewer while a run trains. Yields a function to call after each iteration, with its number.

    The caller holds nerfview's lock, except in that function: the field is never drawn while an iteration changes it, and the
    run's bits are those of a run without a viewer.

    Args:
        report: called with the viewer's address.
    """
    from clear_strategies.viewing.server import Screen, SplatViewer

    viewer = SplatViewer(Screen(painter, cameras), title=title, mode="training")
    report(viewer.address)
    viewer.lock.acquire()
    began = time.monotonic()

    def after_step(iteration: int) -> None:
        nonlocal began
        # nerfview shares the time between both by the pixels of each a second: an iteration counts as one.
        viewer.render_tab_state.num_train_rays_per_sec = 1 / max(time.monotonic() - began, 1e-9)
        viewer.lock.release()
        try:
            viewer.update(iteration, 1)
            if viewer.server.get_clients():
                time.sleep(_TURN)
            while viewer.state == "paused":
                time.sleep(_PATIENCE)
        finally:
            viewer.lock.acquire()
        began = time.monotonic()

    try:
        yield after_step
    finally:
        viewer.lock.release()
        viewer.close()
