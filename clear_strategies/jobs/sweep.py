"""What the jobs of one sweep share, in however many processes they run: cores, failures, and the signal to stop.

The first process puts the path of a folder into the environment, which its jobs inherit, on this machine and on a cluster.
Each job that fails writes a note into that folder. The jobs share nothing else.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import signal
import tempfile
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Final

from clear_strategies import files

_log = logging.getLogger(__name__)

_ENVIRONMENT: Final = "CLEAR_SWEEP"
_STOP: Final = "stop"
FAILED, LEFT = "failed_", "left_"
"""Of a job: it failed; it was left to another process, which holds its folder."""
_POLL_SECONDS: Final = 0.5  # between two checks whether the sweep was stopped


@dataclass(frozen=True, slots=True)
class Sweep:
    """The notes of one sweep, in `folder`; `pid` is the process that began the sweep."""

    folder: Path
    pid: int

    @classmethod
    def begin(cls, folder: Path) -> Sweep:
        """Begin a sweep into `folder`, before its first job."""
        folder.mkdir(parents=True, exist_ok=True)
        notes = tempfile.mkdtemp(prefix=f".sweep_{os.getpid()}_", dir=folder)
        atexit.register(shutil.rmtree, notes, ignore_errors=True)
        os.environ[_ENVIRONMENT] = str(Path(notes).resolve())
        return cls(Path(notes).resolve(), os.getpid())

    @classmethod
    def current(cls) -> Sweep | None:
        """The sweep that this process belongs to, or None."""
        folder = Path(os.environ.get(_ENVIRONMENT, ""))
        if not folder.name.startswith(".sweep_"):
            return None
        return cls(folder, int(folder.name.split("_")[1]))

    @property
    def begun_here(self) -> bool:
        return self.pid == os.getpid()

    def note(self, kind: str, job: int, message: str) -> None:
        """Note what became of a job: `FAILED` or `LEFT`."""
        files.write_text(self.folder / f"{kind}{job:05d}", message)

    def notes(self, kind: str) -> list[str]:
        """What was noted of all jobs, in their order."""
        notes = sorted(self.folder.glob(f"{kind}*"))
        return [f"job {int(note.name.removeprefix(kind))}: {note.read_text()}" for note in notes]

    def stop(self, signum: int) -> None:
        """Ask the jobs of this sweep to save and end, and start no other."""
        files.write_text(self.folder / _STOP, str(int(signum)))

    @property
    def stopped_by(self) -> int | None:
        """The signal, if the sweep was stopped."""
        try:
            return int((self.folder / _STOP).read_text())
        except FileNotFoundError:
            return None


def stop_on_signals(sweep: Sweep) -> None:
    """From now on Ctrl-C and SIGTERM are the sweep's stop, once; a second one acts at once.

    Joblib answers Ctrl-C by killing its workers, in the middle of whatever they write.
    """

    def note(signum: int, _frame: FrameType | None) -> None:
        for s, handler in before.items():
            signal.signal(s, handler)
        sweep.stop(signum)
        name = signal.Signals(signum).name
        _log.warning("%s: the jobs finish their step and save, no other begins. Once more to leave at once.", name)

    before = {s: signal.signal(s, note) for s in (signal.SIGINT, signal.SIGTERM)}


class Watch:
    """Turns the sweep's stop into the signal that training saves at. Called after each iteration."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep, self.next_poll = sweep, 0.0

    def __call__(self) -> None:
        if time.monotonic() < self.next_poll:
            return
        self.next_poll = time.monotonic() + _POLL_SECONDS
        # After a first signal, e.g. a Ctrl-C that reached this worker as well, training has restored the default handler:
        # it is about to save already, and a second signal would kill it.
        if self.sweep.stopped_by is not None and callable(signal.getsignal(signal.SIGTERM)):
            signal.raise_signal(signal.SIGTERM)


def cores() -> int:
    """The cores that this process may use: its affinity, and in a Slurm job no more than the job asked for."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for name in ("SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"):
        if (given := os.environ.get(name, "")).isdecimal():
            return max(1, min(here, int(given)))
    return here


def threads(jobs: int) -> int:
    """Threads per job when `jobs` run at once on this machine; at most torch's own number, which OMP_NUM_THREADS sets.

    Two jobs must not use the same core: OpenMP's threads wait by spinning, so two jobs of two threads on two cores are
    tens of times slower than two jobs of one thread.

    Args:
        jobs: at once; a negative number counts as joblib does: -1 is one job per core, -2 one fewer.
    """
    here = cores()
    at_once = jobs if jobs > 0 else max(1, here + 1 + jobs)
    return max(1, min(_threads_of_torch(), here // at_once))


@cache
def _threads_of_torch() -> int:
    """As it was before the first job changed it; a process may do several jobs."""
    import torch

    return torch.get_num_threads()
