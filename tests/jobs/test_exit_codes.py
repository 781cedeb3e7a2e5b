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


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "stopped by SIGINT."),  # a job says what it has saved
        (
            OSError(errno.ENOSPC, "No space", "x.ply"),
            3,
            "x.ply: No space. Free space, or write elsewhere (hydra.run.dir=",
        ),
        (
            OSError(errno.EROFS, "Read-only", "x.ply"),
            3,
            "x.ply: Read-only. Write elsewhere (hydra.run.dir=FOLDER of a run, --out",
        ),
        (
            OSError("Broken pipe\n\nFFMPEG COMMAND:\nffmpeg"),
            3,
            "output: Broken pipe FFMPEG COMMAND: ffmpeg. Write elsewhere",
        ),
    ],
)
def test_an_error_that_the_user_can_solve_is_one_line_and_an_exit_code(error, code, message) -> None:
    ending = exit_codes.describe(error)
    assert ending is not None
    assert ending.code == code
    assert ending.message.startswith(message)


def test_a_reader_that_leaves_is_no_error(tmp_path: Path) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as gone:
        ended = subprocess.run([sys.executable, "-m", "clear_strategies.run", "--help"], stdout=gone, cwd=tmp_path,
                               env=environment(tmp_path), stderr=subprocess.PIPE, text=True, check=False)  # fmt: skip
    assert (ended.returncode, ended.stderr) == (141, "")
