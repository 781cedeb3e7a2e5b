"""Atomic writes: a file is either whole or as it was before; and the lock of a folder, which has one writer at a time."""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import stat
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

LOCK: Final = "run.lock"
FINISHED: Final = "metrics.json"
"""The last file that a run writes: a folder that has it holds a finished run."""
_PARTIAL: Final = ".partial"
_KEPT: Final = 40  # characters of a file's name in that of its part, so that a name may be as long as the disk allows
_LARGEST: Final = 64 << 30


def expanded(path: str) -> str:
    """A path with the user's folder in place of a `~` in front, which a shell replaces only where a word begins with it."""
    return os.path.expanduser(path)  # noqa: PTH111 - Path.expanduser raises where there is no such user


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file beside the target, flush it to disk, then rename it to the target."""
    with replacing(path) as partial:
        partial.write_bytes(data)
        flush(partial)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """The path that a library writes to in place of `path`, with the same suffix; renamed to it afterwards, or removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # No process number: in containers, which may share a cache, every program has the same one.
    partial = path.with_name(f".{path.stem[:_KEPT]}.{secrets.token_hex(4)}{_PARTIAL}{path.suffix}")
    try:
        yield partial
        _patiently(partial.replace, path)
    except OSError as error:
        if str(error.filename or partial) == str(partial):  # a write to a full disk names no file
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)  # exists only after an exception or Ctrl-C


def _patiently(rename: Callable[[Path], Path], target: Path) -> None:
    """Rename to the target; on Windows again for a second, since a virus scanner may hold a file that was just written."""
    given_up = time.monotonic() + 1
    while True:
        try:
            rename(target)
            return
        except PermissionError:
            waits = sys.platform == "win32" and time.monotonic() < given_up
            if not waits:
                raise
            time.sleep(0.02)


def flush(path: Path) -> None:
    """Have the system write a file, or the names in a folder, to disk. Windows keeps the names by itself, and flushes only a file
    that is open for writing.
    """
    is_folder = path.is_dir()
    if is_folder and sys.platform == "win32":
        return
    descriptor = os.open(path, os.O_RDONLY if is_folder else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def install(complete: Path, folder: Path, last: str) -> None:
    """Rename a folder that is complete to `folder`, or leave it where another process has written the same meanwhile.

    Args:
        last: the file that only a complete `folder` has.
    """
    if not (folder / last).is_file():
        shutil.rmtree(folder, ignore_errors=True)
    try:
        _patiently(complete.rename, folder)
    except OSError:
        if not (folder / last).is_file():
            raise


def require_regular(path: Path, *, most: int = _LARGEST) -> None:
    """Refuse what is no regular file: a pipe blocks for ever, and a device such as /dev/zero has no end.

    A path that does not exist or cannot be examined is left to the caller's own open.

    Raises:
        DataError: it is a pipe, a device or a socket, or has more than `most` bytes.
    """
    try:
        status = path.stat()
    except OSError:
        return
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise DataError(path, "file", "is a pipe, a device or a socket", "give a regular file")
    if status.st_size > most:
        raise DataError(path, "size", f"is more than {most >> 20} MiB", "check the path")


def read_bytes(path: Path, *, most: int = _LARGEST, remedy: str = "check the path") -> bytes:
    """The content of a regular file; a DataError if it cannot be read, or `require_regular` refuses it."""
    require_regular(path, most=most)
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise DataError(path, "file", "is not there", remedy) from error
    except OSError as error:
        raise DataError(path, "file", f"cannot be read ({error.strerror})", remedy) from error


def sweep(folder: Path) -> None:
    """Remove partial files of processes that died from a run's folder. Call it while no other process writes there."""
    for depth in ("", "*/", "*/*/"):
        for left in folder.glob(f"{depth}.*{_PARTIAL}*"):
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)
            _log.debug("%s: removed, a process died while it wrote this.", left)


def write_text(path: Path, text: str) -> None:
    """UTF-8 text, atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """JSON, atomically. NaN and infinities, which JSON does not have, become null."""
    import msgspec

    def plain(value: Any) -> Any:  # numbers of numpy and strings of torch are no float and no str to msgspec
        return dict(value) if isinstance(value, Mapping) else str(value) if isinstance(value, str) else float(value)

    write_bytes(path, msgspec.json.format(msgspec.json.encode(value, enc_hook=plain), indent=1) + b"\n")


class HeldError(DataError):
    """Another running process holds the folder."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Hold the lock of `folder`, which is created if it does not exist, so that it has one writer.

    The system frees the lock of a process that has died, so a killed run does not block the next; the empty file stays.
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise HeldError(
            folder / LOCK, "lock", "another run is at work in this folder", "wait for it, or take another folder"
        ) from error
    try:
        yield
    finally:
        lock.release()


class Beside:
    """Calls functions, one after the other, in a thread of its own: pictures are drawn and encoded while others are rendered, a
    checkpoint is written while training goes on.

    A context. `finish` raises the first error of a call; where it is not reached, what was not begun is left out.
    """

    def __init__(self) -> None:
        self._thread, self._calls = ThreadPoolExecutor(1), deque[Future[object]]()

    def __call__(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call it soon. The arguments must not change any more."""
        self._calls.append(self._thread.submit(function, *arguments))

    def finish(self, *, waits: bool = True) -> None:
        """Wait until all calls have been made; or only raise the error of one that has failed."""
        while self._calls and (waits or self._calls[0].done()):
            self._calls.popleft().result()

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)
