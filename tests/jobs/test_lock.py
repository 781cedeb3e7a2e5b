"""One writer a folder: who holds it is respected while alive, and only then."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from contextlib import nullcontext

import pytest

from clear_strategies import DataError
from clear_strategies.jobs.lock import NAME, HeldError, hold


def leave(folder, **facts):
    """A lock as a process would have left it."""
    mine = {"host": socket.gethostname(), "pid": os.getpid(), "started": "1", "since": "2026-01-01T00:00:00+00:00"}
    (folder / NAME).write_text(json.dumps(mine | facts))


def a_dead_process() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
        return process.pid


def test_a_held_folder_is_refused_and_it_is_released_even_when_the_job_fails(tmp_path):
    folder = tmp_path / "run"
    with hold(folder), pytest.raises(HeldError, match=f"process {os.getpid()} on .* is at work"), hold(folder):
        pass
    with pytest.raises(KeyError), hold(folder):
        raise KeyError
    assert list(folder.iterdir()) == []


def test_what_a_dead_process_left_is_taken_over(tmp_path, caplog):
    leave(tmp_path, pid=a_dead_process())
    with hold(tmp_path):
        assert json.loads((tmp_path / NAME).read_text())["pid"] == os.getpid()
    assert "ended without releasing it" in caplog.text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="tells processes apart by /proc")  # noqa: PTH110
def test_a_process_that_has_the_number_of_a_dead_one_is_another(tmp_path):
    leave(tmp_path, pid=os.getpid(), started="1")  # we were not started one tick after boot
    with hold(tmp_path):
        pass


@pytest.mark.parametrize(("job", "restarts", "taken"), [("7", "1", True), ("7", "0", False), ("8", "1", False)])
def test_a_job_that_slurm_starts_again_elsewhere_takes_over_from_itself(tmp_path, monkeypatch, job, restarts, taken):
    leave(tmp_path, host="elsewhere", slurm_job="7", slurm_restarts=0)
    monkeypatch.setenv("SLURM_JOB_ID", job)
    monkeypatch.setenv("SLURM_RESTART_COUNT", restarts)
    with nullcontext() if taken else pytest.raises(DataError, match="elsewhere"), hold(tmp_path):
        pass


@pytest.mark.parametrize("stale", [True, False])
def test_of_many_at_once_exactly_one_gets_it(tmp_path, stale):
    """In each of many rounds all come to a folder at the same moment, where a dead process may have left its lock."""
    code = (
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
    rounds, dead = 25, a_dead_process()
    for i in range(rounds):
        (tmp_path / f"{i:02d}").mkdir()
        if stale:
            leave(tmp_path / f"{i:02d}", pid=dead)
    command = [sys.executable, "-c", code, str(tmp_path)]
    several = [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(4)]

    def all_say():
        said = sorted(process.stdout.readline().strip() for process in several)
        for process in several:
            process.stdin.write("go on\n")
            process.stdin.flush()
        return said

    assert all_say() == ["ready"] * 4
    assert [all_say() for _ in range(rounds)] == [["got it", "refused", "refused", "refused"]] * rounds
    for process in several:
        process.communicate()
        assert process.returncode == 0
    assert list(tmp_path.rglob("*lock*")) == []


def test_a_lock_removed_by_hand_is_no_error_and_another_s_lock_stays(tmp_path):
    with hold(tmp_path):
        (tmp_path / NAME).unlink()
    assert list(tmp_path.iterdir()) == []
    with hold(tmp_path / "run"):
        shutil.rmtree(tmp_path / "run")
    with hold(tmp_path):
        leave(tmp_path, pid=1)
    assert (tmp_path / NAME).exists()
