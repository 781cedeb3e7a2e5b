"""How a process ends: what it says, and its exit code."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from clear_strategies.jobs import exit_codes
from tests.helpers.command_line import environment


def test_ctrl_c_outside_of_a_job_says_nothing_of_what_was_saved() -> None:
    assert exit_codes.describe(KeyboardInterrupt()) == (130, "stopped by SIGINT.")


@pytest.mark.parametrize(
    ("number", "remedy"), [(errno.ENOSPC, "Free space, or write elsewhere"), (errno.EROFS, "Write")]
)
def test_space_is_a_remedy_of_a_full_disk_alone(number: int, remedy: str) -> None:
    ending = exit_codes.describe(OSError(number, os.strerror(number), "x.ply"))
    code, message = ending
    assert code == exit_codes.NO_DISK
    assert message.startswith(f"x.ply: {os.strerror(number)}. {remedy}")
    assert "--out of a command" in message


def test_the_message_of_a_library_that_cannot_write_is_one_line() -> None:
    ending = exit_codes.describe(OSError("Broken pipe\n\nFFMPEG COMMAND:\nffmpeg -y"))
    assert ending is not None
    assert ending.message.startswith("output: Broken pipe FFMPEG COMMAND: ffmpeg -y. Write elsewhere")


def test_a_reader_that_leaves_is_no_error(tmp_path: Path) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as gone:
        ended = subprocess.run([sys.executable, "-m", "clear_strategies.run", "--help"], stdout=gone, cwd=tmp_path,
                               env=environment(tmp_path), stderr=subprocess.PIPE, text=True, check=False)  # fmt: skip
    assert (ended.returncode, ended.stderr) == (141, "")
