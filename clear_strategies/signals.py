"""Signals that end a program. While training the step in progress finishes, the run saves, and then it stops."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn

from clear_strategies.errors import ClearError

_log = logging.getLogger(__name__)


class Interrupted(ClearError):
    """The run was asked to stop (Ctrl-C, SIGTERM, SIGHUP, a cluster's own signal).

    Args:
        when: for the message, "before iteration 8".
        saved: the newest checkpoint.

    Attributes:
        in_sweep: the message of a job of a sweep, which tells how to go on itself: its command has other jobs as well.
    """

    def __init__(self, signum: int, when: str, saved: Path | None) -> None:
        self.signum, self.exit_code = signum, 128 + signum
        stopped, nothing = f"stopped by {signal.Signals(signum).name} {when}. ", "Nothing was saved."
        self.in_sweep = stopped + (f"It is saved: {saved}." if saved else nothing)
        super().__init__(stopped + (f"Go on by the same command with fit.resume={saved}." if saved else nothing))


TWICE: Final = (signal.SIGINT, signal.SIGTERM)  # a second one acts at once
# The terminal was closed, or its connection lost: the system sends several of them. SIGBREAK: that of Windows, and Ctrl-Break.
_HANGUPS: Final = tuple(getattr(signal, name) for name in ("SIGHUP", "SIGBREAK") if hasattr(signal, name))
STOPS: Final = (*TWICE, *_HANGUPS)
"""Signals that end a run, which saves before."""
# A cluster announces the end of a job with these, if the job's launcher has set a handler.
_ANNOUNCEMENTS: Final = tuple(getattr(signal, name) for name in ("SIGUSR1", "SIGUSR2") if hasattr(signal, name))


Handler = Callable[[int, FrameType | None], object] | signal.Handlers

_collected: Final = list[list[int]]()  # by each `deferred_signals`


def asked() -> bool:
    """Return True if a signal waits for the end of the step in progress."""
    return any(_collected)


@contextmanager
def deferred_signals() -> Iterator[list[int]]:
    """Collect the first of `STOPS` instead of stopping in the middle of a step; after it SIGINT and SIGTERM act at once. What is
    ignored stays so: SIGHUP under nohup, and SIGINT of a job that a script starts with `&`.

    SIGUSR1 and SIGUSR2 are collected where they have a handler (one that resubmits the job, say), since that handler
    would exit before anything is saved. All handlers are restored when `fit` raises Interrupted, so that the caller can
    raise the signal again.
    """
    pending: list[int] = []

    def note(signum: int, _frame: FrameType | None) -> None:
        pending.append(signum)
        again = " Once more to leave at once." if signum in TWICE else ""
        _log.warning("%s: finishing this step, then saving.%s", signal.Signals(signum).name, again)
        for s in before.keys() & {*TWICE}:
            signal.signal(s, before[s])

    handled = [s for s in _ANNOUNCEMENTS if callable(signal.getsignal(s))]
    handled += [s for s in STOPS if signal.getsignal(s) is not signal.SIG_IGN]
    with _handled(handled, note) as before:
        if before:
            _collected.append(pending)
        try:
            yield pending
        finally:
            if before:
                _collected.pop()


@contextmanager
def held() -> Iterator[None]:
    """Hold `STOPS` back: they are raised again behind the scope, with the handlers of before, whatever it has done to these."""
    came = list[int]()
    known = [s for s in STOPS if signal.getsignal(s) is not None]  # others have been set by C
    try:
        with _handled(known, lambda signum, _: came.append(signum)):
            yield
    finally:
        for signum in came:
            signal.raise_signal(signum)


@contextmanager
def _handled(signals: Iterable[int], handler: Handler) -> Iterator[Mapping[int, Any]]:
    """Set the handler of signals, and the handlers of before again, which this yields; without effect in other threads than the
    main one, which alone may set handlers.
    """
    try:
        before = {s: signal.signal(s, handler) for s in signals}
    except ValueError:
        before = {}
    try:
        yield before
    finally:
        for s, earlier in before.items():
            signal.signal(s, earlier)


def handle(handler: Handler) -> None:
    """Set a handler of `STOPS`; those that are ignored stay so."""
    for signum in STOPS:
        if signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, handler)


told: Final = list[int]()
"""The signals that end this process, or the sweep of several that it belongs to. A library that is being imported may lose the
exception of `stop`, and fail later.
"""


def stop(signum: int, _frame: FrameType | None) -> NoReturn:
    """The handler of `STOPS` where no step defers them: as Python's own of Ctrl-C, but it tells the signal."""
    told.append(signum)
    raise KeyboardInterrupt(signum)


def signal_of(error: KeyboardInterrupt) -> signal.Signals:
    """The signal that `stop` tells; Python's own handler is that of SIGINT."""
    return signal.Signals(error.args[0] if error.args else signal.SIGINT)


@contextmanager
def interrupted(when: str, saved: Callable[[], Path | None] = lambda: None) -> Iterator[None]:
    """A signal where no step defers it becomes `Interrupted`, with the checkpoint that is the newest then."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted(signal_of(error), when, saved()) from error


def foremost(pending: list[int]) -> int:
    """The signal that decides how to stop: a cluster's announcement before a SIGTERM that comes with it."""
    return next((s for s in pending if s in _ANNOUNCEMENTS), pending[0])
