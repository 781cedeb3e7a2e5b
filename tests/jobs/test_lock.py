"""One writer a folder: who holds it is respected while alive, and only then."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from clear_strategies.jobs.lock import NAME, HeldError, hold


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


HOLD = """
import sys
from pathlib import Path
from clear_strategies.jobs.lock import hold
with hold(Path(sys.argv[1])):
    print("got it", flush=True)
    sys.stdin.readline()
"""


def test_the_folder_of_a_living_process_is_refused_and_that_of_a_killed_one_is_free(tmp_path):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], **pipes) as process:
        assert process.stdout.readline() == "got it\n"
        with pytest.raises(HeldError), hold(tmp_path):
            pass
        process.kill()
    with hold(tmp_path):
        pass


def test_a_lock_or_a_folder_that_is_removed_by_hand_is_no_error(tmp_path):
    with hold(tmp_path):
        (tmp_path / NAME).unlink()
    with hold(tmp_path / "run"):
        shutil.rmtree(tmp_path / "run")
