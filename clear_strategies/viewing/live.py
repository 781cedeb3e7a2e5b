"""The viewer of a run that trains: pictures are drawn by the training thread, between two iterations."""

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
    """Runs what other threads ask for at the moments that the training thread chooses; after `close`, at once.

    The field is then never drawn while an iteration changes it, and the run's bits are those of a run without a viewer.
    """

    def __init__(self) -> None:
        self._asked: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._closed = threading.Event()

    def ask(self, function: Callable[[], Any]) -> Any:
        """Called by another thread: its result, once the training thread has called it."""
        if self._closed.is_set():
            return function()
        answer: Future[Any] = Future()
        self._asked.put((function, answer))
        while not answer.done():
            if self._closed.is_set():
                self.serve()
            time.sleep(0.002)
        return answer.result()

    def serve(self) -> None:
        """Called by the training thread: do all that was asked for."""
        while True:
            try:
                function, answer = self._asked.get_nowait()
            except queue.Empty:
                return
            try:
                answer.set_result(function())
            except Exception as error:  # it belongs to the thread that asked
                answer.set_exception(error)

    def close(self) -> None:
        """Training has ended: the field changes no more."""
        self._closed.set()


def require_viewer() -> None:
    """Raise a SettingError where one of the viewer's libraries is not installed."""
    if lacks := [name for name in ("viser", "nerfview", "splines") if find_spec(name) is None]:
        raise SettingError(f"the viewer needs {' and '.join(lacks)}: pip install 'clear-strategies[view]'.")


@contextmanager
def watched(
    painter: Painter, cameras: Sequence[SavedCamera], title: str, report: Callable[[str], None]
) -> Iterator[Callable[[int], None]]:
    """A viewer while a run trains. Yields what to call after each iteration, with its number.

    Args:
        report: told the address.
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
        viewer.tell(iteration)

    try:
        yield after_step
    finally:
        turns.close()
        viewer.close()
