"""Runs under the rules of Windows, which `tests.helpers.windows` stands in for, without compiled kernels."""

import errno
import io
import os
import re
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from clear_strategies import console
from clear_strategies.hydra_app import readable
from clear_strategies.options import _one_folder
from clear_strategies.report import _file_names
from tests.helpers import windows
from tests.helpers.command_line import TINY, wait_for

HERE = [*TINY, "rasterizer=torch", "fit.checkpoint_every=2", "fit.keep=1"]
DOOR = ["-m", "clear_strategies.run"]
# What is refused, and by which error. Of the files there, open.txt and folder/inside.txt are open.
REFUSED = {
    "import resource": "ModuleNotFoundError",
    "import os; os.wait4": "AttributeError",
    "import signal; signal.SIGHUP": "AttributeError",
    "import signal; signal.signal(signal.SIGBREAK + 1, print)": "ValueError",
    "import mmap; mmap.MAP_PRIVATE": "AttributeError",
    "import os; os.fsync(os.open('kept.txt', os.O_RDONLY))": "OSError",
    "import os; os.open('.', os.O_RDONLY)": "PermissionError",
    "import threading; threading.Event().wait()": "RuntimeError",
    "Path('kept.txt').read_text()": "EncodingWarning",
    "Path('a:b').mkdir()": "OSError",
    "Path('ends in a dot.').mkdir()": "OSError",
    "Path('aux.txt').write_bytes(b'')": "OSError",
    "Path('Kept.txt').write_bytes(b'')": "RuntimeError",
    "Path('x' * 240).write_bytes(b'')": "FileNotFoundError",
    "Path('open.txt').unlink()": "PermissionError",
    "Path('kept.txt').replace('open.txt')": "PermissionError",
    "Path('folder').rename('other')": "PermissionError",
    "Path('kept.txt').rename('second.txt')": "FileExistsError",
    "Path('link').symlink_to('kept.txt')": "PermissionError",
    "print('λ')": "UnicodeEncodeError",
}
ALLOWED = ["import os; os.fsync(os.open('kept.txt', os.O_RDWR))", "Path('free.txt').replace('second.txt')"]


def test_the_stand_in_refuses_what_windows_refuses(tmp_path):
    for name in ("kept.txt", "free.txt", "second.txt", "open.txt", "folder/inside.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    code = (
        "from pathlib import Path\n"
        "held = open('open.txt', 'rb'), open('folder/inside.txt', 'rb')\n"
        f"for words in {[*REFUSED, *ALLOWED]}:\n"
        "    try:\n"
        "        exec(words, {'__package__': 'clear_strategies', '__name__': 'clear_strategies.x', 'Path': Path})\n"
        "        print('-')\n"
        "    except (Exception, EncodingWarning) as error:\n"
        "        print(type(error).__name__)\n"
    )
    result = windows.run("-c", code, disk=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [*REFUSED.values(), *["-"] * len(ALLOWED)]


def test_a_program_that_begins_is_given_no_file_that_is_open(tmp_path):
    code = (
        "import subprocess\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from pathlib import Path\n"
        "from clear_strategies import files\n"
        "with ThreadPoolExecutor(1) as thread:\n"
        "    programs = thread.submit(lambda: [subprocess.run(['true']) for _ in range(100)])\n"
        "    while not programs.done():\n"
        "        files.write_bytes(Path('written'), b'.')\n"
    )
    result = windows.run("-c", code, disk=tmp_path)
    assert result.returncode == 0, result.stderr


RUNS = """
import signal
from clear_strategies import hydra_app
from clear_strategies.training import loop
from tests.helpers.forked import not_drawn

step, done = loop.iterate, []

def iterate(*arguments):
    done.append(step(*arguments))
    if len(done) == 5:
        signal.raise_signal({number})
    return done[-1]

loop.iterate = iterate
with not_drawn():
    try:
        hydra_app.main({run})
    except SystemExit as ended:
        print("exit code", ended.code)
    hydra_app.main([*{run}, "fit.resume=auto", "fit.video=2"])
    hydra_app.main([*{run}, "fit.overwrite=true", "fit.iterations=2"])
    hydra_app.main({sweep})
"""


def test_a_run_is_stopped_resumed_and_overwritten_and_a_sweep_makes_its_report(tmp_path):
    (experiment := tmp_path / "conf" / "experiment" / "named.yaml").parent.mkdir(parents=True)
    experiment.write_text("# @package _global_\ndefaults: [_sweep]\n")
    run, path = ["+strategy=clear", "hydra.run.dir=one", *HERE], r"data.cloud.path=C:\photos\a:b*.ply"
    sweep = ["+strategy=gco", "experiment=named", "--config-dir=conf", "fit.seed=0,1", path, *HERE, "fit.iterations=2"]
    result = windows.run("-c", RUNS.format(number=windows.BREAK, run=run, sweep=sweep), disk=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    said = (
        "before iteration 6",
        f"exit code {128 + windows.BREAK}",
        "after 5 iterations",
        "of an earlier run; removed",
    )
    assert all(words in result.stdout for words in said), result.stdout
    assert [file.name for file in (tmp_path / "one" / "checkpoints").iterdir()] == ["step_0000003.safetensors"]
    assert len(list((tmp_path / "multirun" / "named").glob("*/metrics.json"))) == 2
    assert (tmp_path / "multirun" / "named" / "report.html").is_file()


class PipeOfWindows(io.FileIO):
    """A pipe whose reader has left."""

    def write(self, data):
        raise OSError(errno.EINVAL, "Invalid argument")


class Output(console._ClosableOutput, PipeOfWindows):
    pass


def test_what_follows_after_a_reader_has_left_is_dropped(tmp_path):
    with Output(tmp_path / "pipe", "w") as output:
        assert output.write(b"words") == 5


@pytest.mark.parametrize(
    ("word", "read"),
    [(r"data.path=\\nas\photos", r"data.path='\\nas\photos'"), (r"data.path=C:\photos", r"data.path=C:\photos")],
)
def test_a_path_of_windows_keeps_its_backslashes(word, read):
    assert readable(word) == read


def test_names_of_folders_stay_as_they_are_where_they_are_legal_and_differ_where_they_are_not():
    assert _one_folder("+strategy=[gco,svs],data.path=a/b") == "+strategy=[gco,svs],data.path=a_b"
    mended = [_one_folder(f"data.path={value}") for value in ("C:", "C*", "C|", "C.", "C ")]
    assert len({*mended}) == 5
    assert not any(windows.ILLEGAL.search(name) for name in mended)


def test_pictures_of_scenes_whose_names_differ_in_case_alone_are_two_files():
    assert _file_names(["fern", "Fern"]) == {"fern": "fern", "Fern": "Fern_"}


def started(*arguments: str, disk: Path, until: Callable[[], bool]) -> subprocess.Popen[str]:
    """A program that has come so far, in a console of its own."""
    command, env = windows.program(*arguments, disk=disk)
    with (disk / "said").open("w") as said:
        process = subprocess.Popen(command, cwd=disk, env=env, stdout=said, stderr=said, start_new_session=True)
    try:
        wait_for(lambda: until() or process.poll() is not None)
        assert process.poll() is None, (disk / "said").read_text()
    except AssertionError:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        raise
    return process


@pytest.mark.slow
@pytest.mark.skipif(find_spec("hydra_plugins") is None, reason="needs clear-strategies[sweeps]")
def test_ctrl_c_saves_the_runs_of_a_sweep_in_processes(tmp_path):
    """A console sends it to all of its processes; what one of them sent to another would end that at once."""
    two = ["hydra/launcher=cores", "hydra.launcher.n_jobs=2", "fit.seed=0,1"]

    def begun() -> bool:
        return len({file.parent for file in (tmp_path / "all").glob("*/checkpoints/*")}) == 2

    words = ["-m", "+strategy=gco", "hydra.sweep.dir=all", *HERE, *two, "fit.iterations=5000"]
    process = started(*DOOR, *words, disk=tmp_path, until=begun)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(600) == 128 + signal.SIGINT, (tmp_path / "said").read_text()
    logs = [file.read_text() for file in (tmp_path / "all").glob("*/run.log")]
    assert len(logs) == 2
    for log in logs:
        assert re.search(r"stopped by SIGINT before iteration \d+. It is saved: ", log)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("viser") is None, reason="needs clear-strategies[view]")
def test_ctrl_c_ends_the_viewer(saved_run, tmp_path):
    def waits() -> bool:
        return "(Ctrl-C ends it)" in (tmp_path / "said").read_text()

    process = started(*DOOR, "view", str(saved_run[0]), "--no-browser", disk=tmp_path, until=waits)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(600) == 0, (tmp_path / "said").read_text()
