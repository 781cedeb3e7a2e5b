"""The viewer of a run that trains: the training thread draws its pictures, between two iterations."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, Final

from clear_strategies.errors import SettingError
from clear_strategies.viewing.cameras import SavedCamera
from clear_strategies.viewing.look import Painter

_PATIENCE: Final = 0.02  # seconds between looks at the queue while the run is paused


class Turns:
    """Runs functions of other threads in the training thread, when that calls `serve`; after `close`, in their own.

    The field is thus never drawn while an iteration changes it, and the run's bits are those of a run without a viewer.
    """

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._closed = threading.Event()

    def ask(self, function: Callable[[], Any]) -> Any:
        """Called by another thread: wait until the training thread has called the function, and return its result."""
        if self._closed.is_set():
            return function()
        result: Future[Any] = Future()
        self._calls.put((function, result))
        while not result.done():
            if self._closed.is_set():
                self.serve()
            time.sleep(0.002)
        return result.result()

    def serve(self) -> None:
        """Called by the training thread: call the functions that wait."""
        while True:
            try:
                function, result = self._calls.get_nowait()
            except queue.Empty:
                return
            try:
                result.set_result(function())
            except Exception as error:  # raised in the thread that waits
                result.set_exception(error)

    def close(self) -> None:
        """Called when training has ended and the field no longer changes."""
        self._closed.set()


def require_viewer() -> None:
    """Raise a SettingError where one of the viewer's libraries is not installed."""
    if missing := [name for name in ("viser", "nerfview", "splines") if find_spec(name) is None]:
        raise SettingError(f"the viewer needs {' and '.join(missing)}: pip install 'clear-strategies[view]'.")


@contextmanager
def watched(
    painter: Painter, cameras: Sequence[SavedCamera], title: str, report: Callable[[str], None]
) -> Iterator[Callable[[int], None]]:
    """A viewer while a run trains. Yields a function to call after each iteration, with its number.

    Args:
        report: called with the viewer's address.
    """
    from clear_strategies.viewing import points
    from clear_strategies.viewing.server import Screen, SplatViewer

    turns = Turns()
    screen = Screen(painter, cameras, lambda: points.colors(painter, None, ()))
    viewer = SplatViewer(screen, title=title, names=points.names(None), live=True, around=turns.ask)
    report(viewer.address)

    def after_step(iteration: int) -> None:
        turns.serve()
        while viewer.paused:
            turns.serve()
            time.sleep(_PATIENCE)
        viewer.show_progress(iteration)

    try:
        yield after_step
    finally:
        turns.close()
        viewer.close()
