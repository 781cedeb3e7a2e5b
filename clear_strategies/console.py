"""Messages on the terminal. conf/config.yaml sets a run's logging up with this.

INFO is for everybody: the plan, what takes long, the result and where to look next. DEBUG is for those who ask (`-v`): every
round of the densifier, timings, which kernels were chosen. Warnings are always shown, but for those of libraries. A
run's run.log has all three.
"""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import logging.handlers
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, TextIO

_OURS: Final = ("clear_strategies", "rasterizers", "integration")

# Libraries, and Python's warnings ("py.warnings"), whose remarks are for run.log: nobody who trains can do anything about them.
_LIBRARIES: Final = (
    "asyncio", "fontTools", "imageio", "kornia", "matplotlib", "PIL", "py", "torch", "trimesh", "viser", "websockets",
)  # fmt: skip
_LEFT: Final = (errno.EPIPE, errno.EIO, errno.EINVAL)  # the last of a pipe of Windows
_PREFIXES: Final = {logging.WARNING: "warning: ", logging.ERROR: "error: ", logging.CRITICAL: "error: "}


class _ClosableOutput(io.FileIO):
    """A file descriptor that drops what is written after its reader has closed it."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in _LEFT:
                raise
            gone = os.open(os.devnull, os.O_WRONLY)
            os.dup2(gone, self.fileno())
            os.close(gone)
            return len(data)


def harden_output() -> None:
    """Make stdout and stderr survive a closed pipe or terminal: later output is dropped, as `| head` requires.

    Characters that the console cannot encode are escaped. Every entry point calls this first.
    """
    for name in ("stdout", "stderr"):
        if (stream := getattr(sys, name)) is None:  # the program was started without it
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115 - as long as the program
        elif stream is getattr(sys, f"__{name}__"):  # else of a test or a notebook
            setattr(sys, name, _hardened(stream))


def _hardened(stream: io.TextIOWrapper) -> io.TextIOWrapper:
    if not isinstance(getattr(stream.buffer, "raw", stream.buffer), io.FileIO):  # the console of Windows
        stream.reconfigure(errors="backslashreplace")
        return stream
    stream.flush()
    raw, at_once = _ClosableOutput(stream.fileno(), "w", closefd=False), stream.write_through
    return io.TextIOWrapper(
        raw if at_once else io.BufferedWriter(raw),
        stream.encoding, errors="backslashreplace", line_buffering=stream.line_buffering, write_through=at_once,
    )  # fmt: skip


class Console(logging.StreamHandler[Any]):
    """Writes messages above a progress bar, warnings and errors with a prefix; of libraries only errors.

    Args:
        stream: None: stdout.
        verbose: also details, which otherwise only run.log has.
        tag: before each message and its prefix.
    """

    def __init__(self, stream: TextIO | io.TextIOBase | None = None, *, verbose: bool = False, tag: str = "") -> None:
        if stream is None:
            harden_output()  # a launcher's processes do not pass `run.main`
        super().__init__(stream if stream is not None else sys.stdout)
        self._tag = tag
        self.setLevel(logging.DEBUG if verbose else logging.INFO)
        self.addFilter(lambda record: record.levelno > logging.WARNING or record.name.split(".")[0] not in _LIBRARIES)

    def format(self, record: logging.LogRecord) -> str:
        return self._tag + _PREFIXES.get(record.levelno, "") + super().format(record)

    def emit(self, record: logging.LogRecord) -> None:
        bars = getattr(sys.modules.get("tqdm"), "tqdm", None)  # not imported: there is no bar
        with contextlib.nullcontext() if bars is None else bars.external_write_mode(file=self.stream):
            super().emit(record)


def show(*, verbose: bool = False) -> None:
    """Messages go to stderr, for programs that Hydra does not start; without effect where logging is set up already."""
    logging.basicConfig(handlers=[Console(sys.stderr, verbose=verbose)], level=logging.INFO, format="%(message)s")
    for name in _OURS if verbose else ():
        logging.getLogger(name).setLevel(logging.DEBUG)


def show_in_host() -> None:
    """In another trainer, print our messages as "[clear] …" to stderr, above its bar, unless it handles logging itself."""
    if logging.getLogger().handlers or sys.stderr is None:
        return
    handler = Console(sys.stderr, tag="[clear] ")
    for logger in map(logging.getLogger, _OURS):
        if not logger.handlers:
            logger.addHandler(handler)
            logger.setLevel(logging.INFO)


@contextlib.contextmanager
def logged(path: Path) -> Iterator[Callable[[], None]]:
    """Write all messages to a file, those for `-v` and Python's warnings included, once the function that this yields has been
    called. The warnings are not shown meanwhile: matplotlib has one for each letter that its font lacks.
    """
    shown = warnings.showwarning
    logging.captureWarnings(True)
    kept = logging.handlers.MemoryHandler(sys.maxsize, sys.maxsize, flushOnClose=False)
    before = {logger: logger.level for logger in map(logging.getLogger, _OURS)}

    def write() -> None:
        if kept.target is None:
            file = logging.FileHandler(path, encoding="utf-8")
            file.setFormatter(logging.Formatter("%(asctime)s  %(message)s", "%H:%M:%S"))
            kept.setTarget(file)
            kept.capacity = 1  # from now on at once
            kept.flush()

    logging.getLogger().addHandler(kept)
    for logger in before:
        logger.setLevel(logging.DEBUG)
    try:
        yield write
    finally:
        if warnings.showwarning is not shown:  # else the whole program logs them
            logging.captureWarnings(False)
        logging.getLogger().removeHandler(kept)
        for logger, level in before.items():
            logger.setLevel(level)
        if kept.target is not None:
            kept.target.close()
