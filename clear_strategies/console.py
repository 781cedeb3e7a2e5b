"""Messages on the terminal. conf/config.yaml sets a run's logging up with this.

INFO is for everybody: the plan, what takes long, the result and where to look next. DEBUG is for those who ask (`-v`): every
round of the densifier, timings, which kernels were chosen. Warnings are always shown, but for those of libraries. A
run's run.log has all three.
"""

from __future__ import annotations

import contextlib
import io
import logging
import logging.handlers
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, TextIO

_OURS: Final = ("clear_strategies", "rasterizers", "integration")

# Libraries, and Python's warnings ("py.warnings"), whose remarks are for run.log: nobody who trains can do anything about them.
_LIBRARIES: Final = (
    "asyncio", "fontTools", "imageio", "kornia", "matplotlib", "PIL", "py", "torch", "trimesh", "viser", "websockets",
)  # fmt: skip
_PREFIXES: Final = {logging.WARNING: "warning: ", logging.ERROR: "error: ", logging.CRITICAL: "error: "}


class Console(logging.StreamHandler[Any]):
    """Writes messages above a progress bar, warnings and errors with a prefix; of libraries only errors.

    Args:
        stream: None: stdout.
        verbose: also details, which otherwise only run.log has.
    """

    def __init__(self, stream: TextIO | io.TextIOBase | None = None, *, verbose: bool = False) -> None:
        super().__init__(stream if stream is not None else sys.stdout)
        self.setLevel(logging.DEBUG if verbose else logging.INFO)
        self.addFilter(lambda record: record.levelno > logging.WARNING or record.name.split(".")[0] not in _LIBRARIES)

    def format(self, record: logging.LogRecord) -> str:
        return _PREFIXES.get(record.levelno, "") + super().format(record)

    def emit(self, record: logging.LogRecord) -> None:
        bars = sys.modules.get("tqdm")  # not imported: there is no bar
        with contextlib.nullcontext() if bars is None else bars.tqdm.external_write_mode(file=self.stream):
            super().emit(record)


def show(*, verbose: bool = False) -> None:
    """Messages go to stderr, for programs that Hydra does not start; without effect where logging is set up already."""
    logging.basicConfig(handlers=[Console(sys.stderr, verbose=verbose)], level=logging.INFO, format="%(message)s")
    for name in _OURS if verbose else ():
        logging.getLogger(name).setLevel(logging.DEBUG)


def show_in_host() -> None:
    """Print our messages as "[clear] …" to stderr in another trainer, unless it handles logging itself."""
    if logging.getLogger().handlers:
        return
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("[clear] %(message)s"))
    for logger in map(logging.getLogger, _OURS):
        if not logger.handlers:
            logger.addHandler(handler)
            logger.setLevel(logging.INFO)


@contextlib.contextmanager
def logged(path: Path) -> Iterator[Callable[[], None]]:
    """Write all messages to a file, those for `-v` included, once the function that this yields has been called."""
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
        logging.getLogger().removeHandler(kept)
        for logger, level in before.items():
            logger.setLevel(level)
        if kept.target is not None:
            kept.target.close()
