"""Floor 0: one writer a folder. A job holds `run.lock` while it writes; what a dead job left is recognised and taken over.

Dead is known of a process on this host, and of an earlier try of the same Slurm job: Slurm starts a job again only after
it has ended it. Of another host nothing is known, so its lock is respected.
"""

from __future__ import annotations

import datetime
import json
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

NAME: Final = "run.lock"


class HeldError(DataError):
    """A process that runs is at work in the folder."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Be the only one who writes into `folder`, which is made if need be.

    Raises:
        HeldError: another process on this host holds it. DataError: whether its holder still runs cannot be known here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / NAME
    mine = json.dumps(_me())
    while not _create(path, mine):
        _take_away_if_stale(path)
    try:
        yield
    finally:
        if _read(path) == mine:
            path.unlink(missing_ok=True)


def _create(path: Path, text: str) -> bool:
    try:
        with path.open("x") as file:
            file.write(text)
    except FileExistsError:
        return False
    except OSError:
        path.unlink(missing_ok=True)  # a full disk: an empty lock would be nobody's
        raise
    return True


def _take_away_if_stale(path: Path) -> None:
    text = _read(path)
    if text is None:
        return  # released in the meantime
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
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.rename(aside)  # of several who find it stale, one moves it
    except FileNotFoundError:
        return
    if _read(aside) == text:
        _log.warning("%s: %s ended without releasing it; taken over.", path, name)
    else:  # it was taken over by another in the meantime: back with it
        os.link(aside, path)
    aside.unlink()


def _me() -> dict[str, Any]:
    return {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "started": _started(os.getpid()),
        "since": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        **_slurm(),
    }


def _slurm() -> dict[str, Any]:
    """Which Slurm job this is, and which try of it."""
    job, again = os.environ.get("SLURM_JOB_ID"), os.environ.get("SLURM_RESTART_COUNT", "0")
    return {"slurm_job": job, "slurm_restarts": int(again) if again.isdecimal() else 0} if job else {}


def _alive(holder: dict[str, Any]) -> bool | None:
    """Whether who wrote the lock still runs; None: not to be known from here."""
    mine = _slurm()
    if mine and holder.get("slurm_job") == mine["slurm_job"] and holder["slurm_restarts"] < mine["slurm_restarts"]:
        return False
    if holder.get("host") != socket.gethostname() or not isinstance(holder.get("pid"), int):
        return None
    return holder.get("started") == _started(holder["pid"])


def _started(pid: int) -> str | None:
    """When the process was started, in ticks since boot, so that a reused number is another process; None: it is gone."""
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


def _read(path: Path) -> str | None:
    try:
        return path.read_text()
    except FileNotFoundError:
        return None


def _parsed(text: str) -> dict[str, Any]:
    """Of a damaged lock nothing is known."""
    try:
        content = json.loads(text)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}
