"""Programs forked off a process that has imported what they import, which takes most of the time of so short a run.

Each is a process as `python -m` makes one, with arguments, a folder, an environment, signals and an exit code of its own.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
from contextlib import nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import IO, Any

from tests.helpers import pictures

ROOT = Path(__file__).resolve().parents[2]
# What a run imports. None of them starts a thread or asks for a GPU, which no fork would have.
_IMPORTED = (
    "clear_strategies.hydra_app", "clear_strategies.jobs.job", "clear_strategies.report", "cv2", "imageio_ffmpeg", "jinja2",
    "matplotlib.backends.backend_agg", "rasterizers.cpp", "scipy.spatial", "skimage.data", "skimage.metrics",
    "skimage.transform", "warp",
)  # fmt: skip


class Forked:
    """A program that runs, with the methods of subprocess.Popen that tests use.

    Args:
        arguments: of python: `-m MODULE …` or `-c CODE …`. said: what it prints goes there, what it warns of to `errors`.
        session: whether it leads a process group. drawn: whether a run draws its pictures.
    """

    def __init__(
        self, *arguments: str, cwd: Path, env: dict[str, str], said: IO[str], errors: IO[str], session: bool = False,
        drawn: bool = False,
    ) -> None:  # fmt: skip
        asked = {"arguments": arguments, "cwd": str(cwd), "env": env, "session": session, "drawn": drawn}
        self._ends, its_end = socket.socketpair()
        with its_end:
            socket.send_fds(_forks(), [b"."], [said.fileno(), errors.fileno(), its_end.fileno()])
        _forks().sendall(f"{json.dumps(asked)}\n".encode())
        self.pid, self.returncode = _received(self._ends), None

    def wait(self, timeout: float = 600) -> int:
        if self.returncode is None:
            self._ends.settimeout(timeout)
            with self._ends:
                self.returncode = _received(self._ends)
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _received(ends: socket.socket) -> int:
    if len(told := ends.recv(8, socket.MSG_WAITALL)) < 8:
        raise RuntimeError("the process that forks has ended")
    return int.from_bytes(told, "big", signed=True)


def _send(ends: socket.socket, number: int) -> None:
    ends.sendall(number.to_bytes(8, "big", signed=True))


@cache
def _forks() -> socket.socket:
    """Asks the process that forks, which ends with this one."""
    ours, its = socket.socketpair()
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.helpers.forked", str(its.fileno())]
    with its:
        process = subprocess.Popen(command, cwd=ROOT, env=env, pass_fds=[its.fileno()])

    @atexit.register
    def end() -> None:
        ours.close()
        process.wait()

    return ours


def _serve(asks: socket.socket) -> dict[str, Any] | None:
    """Fork for each that asks. Returns what was asked in the fork, and None at the end."""
    while True:
        _, received, *_ = socket.recv_fds(asks, 1, 3)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG if received else 0)[0]:
                pass
        if not received:
            return None
        with asks.makefile() as lines:
            asked = json.loads(lines.readline())
        if os.fork() == 0:
            _become(asked, *received)
            return asked
        for file in received:
            os.close(file)


def _become(asked: dict[str, Any], said: int, errors: int, ends: int) -> None:
    """Make this process the one that was asked for; its parent waits for it and tells how it ended."""
    with socket.socket(fileno=ends) as told:
        if pid := os.fork():
            _send(told, pid)
            _send(told, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
            os._exit(0)
    if asked["session"]:
        os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    os.chdir(asked["cwd"])
    os.environ.clear()
    os.environ.update(asked["env"])
    os.dup2(said, 1)
    os.dup2(errors, 2)
    sys.path[0] = asked["cwd"]


def main() -> None:
    """What `python -m tests.helpers.forked FILENO` does."""
    for name in _IMPORTED:
        importlib.import_module(name)
    with socket.socket(fileno=int(sys.argv[1])) as asks:
        asked = _serve(asks)
    if asked is None:
        return
    kind, what, *arguments = asked["arguments"]
    sys.argv = ["-c", *arguments]
    with nullcontext() if asked["drawn"] else pictures.not_drawn():
        if kind == "-c":
            exec(what, {"__name__": "__main__"})  # noqa: S102 - a test's own
        else:
            sys.modules.pop(what, None)
            runpy.run_module(what, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
