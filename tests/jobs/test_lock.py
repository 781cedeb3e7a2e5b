"""One writer a folder: who holds it is respected while alive, and only then."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from clear_strategies.jobs.lock import NAME, HeldError, hold

HOLD = (
    "import sys\n"
    "from pathlib import Path\n"
    "from clear_strategies.jobs.lock import HeldError, hold\n"
    "def say(word):\n"
    "    print(word, flush=True)\n"
    "    sys.stdin.readline()\n"
    "say('ready')\n"
    "for folder in sorted(Path(sys.argv[1]).iterdir()):\n"
    "    try:\n"
    "        with hold(folder):\n"
    "            say('got it')\n"
    "    except HeldError:\n"
    "        say('refused')\n"
)


def processes(folders: Path, count: int) -> list[subprocess.Popen[str]]:
    """They try to hold each folder in turn, say so, and go on when they are told to."""
    command = [sys.executable, "-c", HOLD, str(folders)]
    return [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(count)]


def said(process: subprocess.Popen[str]) -> str:
    return process.stdout.readline().strip()


def go_on(process: subprocess.Popen[str]) -> None:
    process.stdin.write("go on\n")
    process.stdin.flush()


def test_a_held_folder_is_refused_and_it_is_released_even_when_the_job_fails(tmp_path):
    folder = tmp_path / "run"
    with (
        hold(folder),
        pytest.raises(HeldError, match=r"run\.lock: lock: another run is at work .*: wait"),
        hold(folder),
    ):
        pass
    for _ in range(2):
        with pytest.raises(KeyError), hold(folder):
            raise KeyError


def test_a_killed_process_does_not_block_the_next(tmp_path):
    (tmp_path / "run").mkdir()
    (process,) = processes(tmp_path, 1)
    assert said(process) == "ready"
    go_on(process)
    assert said(process) == "got it"
    with pytest.raises(HeldError), hold(tmp_path / "run"):
        pass
    process.kill()
    process.communicate()
    with hold(tmp_path / "run"):
        pass


def test_of_many_at_once_exactly_one_gets_it(tmp_path):
    """In each of many rounds all come to a folder at the same moment."""
    rounds = 25
    for i in range(rounds):
        (tmp_path / f"{i:02d}").mkdir()
    several = processes(tmp_path, 4)

    def all_say() -> list[str]:
        words = sorted(map(said, several))
        for process in several:
            go_on(process)
        return words

    assert all_say() == ["ready"] * 4
    assert [all_say() for _ in range(rounds)] == [["got it", "refused", "refused", "refused"]] * rounds
    for process in several:
        process.communicate()
        assert process.returncode == 0


def test_a_lock_or_a_folder_that_is_removed_by_hand_is_no_error(tmp_path):
    with hold(tmp_path):
        (tmp_path / NAME).unlink()
    with hold(tmp_path / "run"):
        shutil.rmtree(tmp_path / "run")
