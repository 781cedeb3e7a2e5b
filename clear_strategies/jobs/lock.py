"""One writer per folder: a job holds `run.lock` while it writes, and takes over the lock of a job that has died.

The lock names its holder, for messages, and works on a file system without `flock`. Whether a process of this host has died
can be checked; an earlier try of the same Slurm job has, because Slurm starts a job again only after it has ended. The lock
of another host is respected, because its processes cannot be checked. (The `filelock` package has no holder's name, and
decides by `flock` alone, which network file systems of clusters often lack.)
"""

from __future__ import annotations

import datetime
import fcntl
import json
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, TextIO

from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

NAME: Final = "run.lock"


class HeldError(DataError):
    """Another running process holds the folder."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Hold the lock of `folder`, which is created if it does not exist.

    Raises:
        HeldError: another process on this host holds it. DataError: whether its holder still runs cannot be known here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / NAME
    holder = json.dumps(_this_process())
    with _exclusive(path) as file:
        earlier = file.read()
        if earlier:  # empty: this call has created it
            _require_stale(path, earlier)
        try:
            file.truncate(0)
            file.write(holder)
            file.flush()
        except OSError:  # a full disk: a partial lock names no owner
            path.unlink(missing_ok=True)
            raise
    try:
        yield
    finally:
        with suppress(FileNotFoundError), _exclusive(path) as file:  # the whole folder may be gone
            if file.read() in (holder, ""):  # empty: it had been removed, and this call created it again
                path.unlink(missing_ok=True)


@contextmanager
def _exclusive(path: Path) -> Iterator[TextIO]:
    """Open the lock file, created if it does not exist, while no other process reads or writes it."""
    while True:
        with _opened(path) as file:
            with suppress(OSError):  # a file system that has no such locks: only starts at the same moment go unnoticed
                fcntl.flock(file, fcntl.LOCK_EX)
            if not _is_at(path, file):  # its owner removed it in the meantime
                continue
            file.seek(0)
            yield file
            return


def _opened(path: Path) -> TextIO:
    """The lock file, for reading and writing. A link, which would lead the lock out of the folder, is a DataError."""
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise DataError(path, "lock", "is a link or no regular file", "remove it, if no other run made it")
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0), 0o666)
    return os.fdopen(descriptor, "a+")


def _is_at(path: Path, file: TextIO) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _require_stale(path: Path, text: str) -> None:
    holder = _parsed(text)
    name = f"process {holder.get('pid', '?')} on {holder.get('host', 'an unknown host')}"
    since = f"since {holder.get('since', 'an unknown time')}"
    alive = _alive(holder)
    if alive:
        raise HeldError(
            path, "lock", f"{name} is at work in this folder {since}", "wait for it, or take another folder"
        )
    if alive is None:
        problem = f"{name} took this folder {since}; whether it still runs cannot be known from {socket.gethostname()}"
        raise DataError(path, "lock", problem, "if it does not run any more, remove this file")
    _log.warning("%s: %s ended without releasing it; taken over.", path, name)


def _this_process() -> dict[str, Any]:
    return {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "started": _started(os.getpid()),
        "since": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        **_slurm(),
    }


def _slurm() -> dict[str, Any]:
    """The Slurm job of this process, and how often Slurm has restarted it."""
    job, again = os.environ.get("SLURM_JOB_ID"), os.environ.get("SLURM_RESTART_COUNT", "0")
    return {"slurm_job": job, "slurm_restarts": int(again) if again.isdecimal() else 0} if job else {}


def _alive(holder: dict[str, Any]) -> bool | None:
    """Whether the process that wrote the lock still runs; None: this host cannot check it."""
    job = _slurm()
    if job and holder.get("slurm_job") == job["slurm_job"] and holder["slurm_restarts"] < job["slurm_restarts"]:
        return False
    if holder.get("host") != socket.gethostname() or not isinstance(holder.get("pid"), int):
        return None
    return holder.get("started") == _started(holder["pid"])


def _started(pid: int) -> str | None:
    """When the process started, in ticks since boot, since process numbers are reused; None: it has ended."""
    try:
        # The command, in parentheses, may hold anything; after it come the state (field 3) and the rest.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] in ("Z", "X") else fields[19]
    except OSError:
        if Path("/proc/self/stat").exists():
            return None
    try:  # a system without /proc
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    return "unknown"


def _parsed(text: str) -> dict[str, Any]:
    """The holder; nothing where the lock is damaged."""
    try:
        content = json.loads(text)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}
