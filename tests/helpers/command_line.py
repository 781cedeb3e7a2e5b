"""Runs of the command line in processes of their own, tiny ones."""

import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.helpers.forked import Forked, python_path

ALONE = ["fit.video=0", "fit.map_views=0"]
"""A run that writes little beside its field."""
OF_DEMO = [
    "data.reader.width=64",
    "data.reader.height=48",
    "data.reader.views=5",
    "data.reader.train=2",
    "data.views.train=2",
]
RANDOM_POINTS = ["data.cloud.init=random", "data.cloud.random_points=60"]
TINY = [*OF_DEMO, *RANDOM_POINTS, "fit.iterations=12", "fit.max_degree=1", "skips=none", *ALONE]
"""A tiny run of the demo."""


def read_by(function: str) -> list[str]:
    """Overrides by which a function without arguments reads the data set in place of the demo's."""
    return [
        *(f"~data.reader.{name}" for name in ("width", "height", "views", "train")),
        f"data.reader._target_={function}",
    ]


def environment(cwd: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": python_path(), "CLEAR_CACHE": str(cwd / "cache"), "OMP_NUM_THREADS": "1"}


def run(
    *arguments: str, cwd: Path, module: str = "clear_strategies.run", code: str | None = None, drawn: bool = False
) -> subprocess.CompletedProcess[str]:
    """A run to its end, as subprocess.run, or another module or code; with pictures only if `drawn`."""
    with tempfile.TemporaryFile("w+") as stdout, tempfile.TemporaryFile("w+") as stderr:
        command = [*(["-m", module] if code is None else ["-c", code]), *arguments]
        ended = Forked(*command, cwd=cwd, env=environment(cwd), stdout=stdout, stderr=stderr, drawn=drawn).wait()
        for file in (stdout, stderr):
            file.seek(0)
        return subprocess.CompletedProcess(command, ended, stdout.read(), stderr.read())


def started(*arguments: str, said: Path, cwd: Path, session: bool = False) -> Forked:
    """A run that goes on; its output goes to the file `said`. `arguments` begin with those of python, `-c …` or `-m …`."""
    with said.open("w") as file:
        return Forked(*arguments, cwd=cwd, env=environment(cwd), stdout=file, stderr=file, session=session)


def times_of_files(folder: Path) -> dict[Path, int]:
    """When each file below a folder was written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def stopped_by(*signals: int, after: int) -> str:
    """Code of a run that gets these signals after some iterations."""
    return (
        "import itertools, os\n"
        "from clear_strategies.run import main\n"
        "from clear_strategies.training import loop\n"
        "done, step = itertools.count(1), loop.iterate\n"
        "def iterate(*arguments):\n"
        "    update = step(*arguments)\n"
        f"    if next(done) == {after}:\n"
        f"        for number in {[int(number) for number in signals]}:\n"
        "            os.kill(os.getpid(), number)\n"
        "    return update\n"
        "loop.iterate = iterate\n"
        "main()\n"
    )


def wait_for(condition: Callable[[], bool], what: str = "it") -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline, f"waited 120 s for {what}"
        time.sleep(0.05)
