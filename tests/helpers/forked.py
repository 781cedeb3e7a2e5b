"""Programs forked off a process that has imported what they import, which takes most of the time of so short a run.

Each is a process as `python -m` makes one, with arguments, a folder, an environment, signals and an exit code of its own.
"""

import atexit
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import IO, Any

import pytest

from tests.helpers.paths import ROOT

# What a run imports. None of them starts a thread or asks for a GPU, which no fork would have.
_IMPORTED = (
    "clear_strategies.hydra_app", "clear_strategies.jobs.job", "clear_strategies.report", "cv2", "filelock", "imageio_ffmpeg",
    "jinja2", "matplotlib.backends.backend_agg", "rasterizers.cpp", "scipy.ndimage", "scipy.spatial", "skimage.data",
    "skimage.metrics", "skimage.transform", "warp",
)  # fmt: skip


class Forked:
    """A running program, with the methods of subprocess.Popen that tests use.

    Args:
        arguments: of python: `-m MODULE …` or `-c CODE …`.
        session: whether it leads a process group.
        drawn: whether a run draws its pictures, and Python takes its objects apart at the end, see `_end`.
    """

    def __init__(
        self, *arguments: str, cwd: Path, env: dict[str, str], stdout: IO[str], stderr: IO[str], session: bool = False,
        drawn: bool = False,
    ) -> None:  # fmt: skip
        request = {"arguments": arguments, "cwd": str(cwd), "env": env, "session": session, "drawn": drawn}
        self._status, child_end = socket.socketpair()
        with child_end:
            socket.send_fds(_server(), [b"."], [stdout.fileno(), stderr.fileno(), child_end.fileno()])
        _server().sendall(f"{json.dumps(request)}\n".encode())
        self.pid, self.returncode = _received(self._status), None

    def wait(self, timeout: float = 600) -> int:
        if self.returncode is None:
            self._status.settimeout(timeout)
            with self._status:
                self.returncode = _received(self._status)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Nothing where it has ended, whose number may be another program's by now."""
        if self.returncode is None and not select.select([self._status], [], [], 0)[0]:
            with suppress(ProcessLookupError):  # it ends just now
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


@contextmanager
def not_drawn() -> Iterator[None]:
    """A run without its pictures, which matplotlib draws in nine tenths of so short a run, by what writes all files."""
    from clear_strategies.outputs import results

    with pytest.MonkeyPatch.context() as patch:
        for name in ("write_curves", "write_contact_sheet"):
            patch.setattr(results, name, lambda *_: None)
        yield


def _received(status: socket.socket) -> int:
    if len(data := status.recv(8, socket.MSG_WAITALL)) < 8:
        raise RuntimeError("the process that forks has ended")
    return int.from_bytes(data, "big", signed=True)


def _send(status: socket.socket, number: int) -> None:
    status.sendall(number.to_bytes(8, "big", signed=True))


def python_path() -> str:
    """This checkout's modules before those that the caller's PYTHONPATH names."""
    return os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))


@cache
def _server() -> socket.socket:
    """Sends requests to the process that forks, which ends with this one."""
    requests, server_end = socket.socketpair()
    env = {**os.environ, "PYTHONPATH": python_path(), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.helpers.forked", str(server_end.fileno())]
    with server_end:
        process = subprocess.Popen(command, cwd=ROOT, env=env, pass_fds=[server_end.fileno()])

    @atexit.register
    def end() -> None:
        requests.close()
        process.wait()

    return requests


def _serve(requests: socket.socket) -> dict[str, Any] | None:
    """Fork for each request. Returns the request in the fork, and None at the end."""
    while True:
        _, received, *_ = socket.recv_fds(requests, 1, 3)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG if received else 0)[0]:
                pass
        if not received:
            return None
        with requests.makefile() as lines:
            request = json.loads(lines.readline())
        if os.fork() == 0:
            _become(request, *received)
            return request
        for file in received:
            os.close(file)


def _become(request: dict[str, Any], stdout: int, stderr: int, status_file: int) -> None:
    """Make this process the requested one; its parent waits for it and sends its exit code."""
    with socket.socket(fileno=status_file) as status:
        if pid := os.fork():
            _send(status, pid)
            _send(status, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
            os._exit(0)
    if request["session"]:
        os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    os.dup2(stdout, 1)
    os.dup2(stderr, 2)
    sys.path[0] = request["cwd"]


def _compute_ahead() -> None:
    """What a process computes at its first configuration and its first picture of the demo, and keeps: the tables of Hydra's
    parser, and the photographs and the light of the demo's room.
    """
    from clear_strategies.data.readers import demo
    from clear_strategies.options import composed_by_hydra

    composed_by_hydra(["+strategy=best"], "config")
    demo.read(width=1, height=1).frames[0].load()


def _end(code: int) -> None:
    """End as Python does, but for its objects, the destruction of which one by one first copies what this process shares with
    its parent: a third of a second. Returns where the output cannot be written, which Python tells itself.
    """
    threading._shutdown()
    atexit._run_exitfuncs()
    with suppress(OSError, ValueError):
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


def main() -> None:
    """What `python -m tests.helpers.forked FILENO` does."""
    for name in _IMPORTED:
        importlib.import_module(name)
    _compute_ahead()
    gc.freeze()  # a fork would take a second to end, and copy all of these objects' memory, to find no garbage among them
    with socket.socket(fileno=int(sys.argv[1])) as requests:
        request = _serve(requests)
    if request is None:
        return
    kind, program, *arguments = request["arguments"]
    sys.argv, code = ["-c", *arguments], None
    try:
        with nullcontext() if request["drawn"] else not_drawn():
            if kind == "-c":
                exec(program, {"__name__": "__main__"})  # noqa: S102 - a test's own
            else:
                sys.modules.pop(program, None)
                runpy.run_module(program, run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        code = ended.code
    if isinstance(code, int | None) and not request["drawn"]:
        _end(code or 0)
    sys.exit(code)


if __name__ == "__main__":
    main()
