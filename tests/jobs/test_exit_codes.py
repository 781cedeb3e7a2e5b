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

ENDINGS = {
    KeyboardInterrupt(): (130, "stopped by SIGINT."),  # a job says what it has saved
    OSError(errno.ENOSPC, "No space", "x"): (3, "x: No space. Free space, or write elsewhere (hydra.run.dir=FOLDER"),
    OSError(errno.EROFS, "Read-only", "x"): (
        3,
        "x: Read-only. Write elsewhere (hydra.run.dir=FOLDER of a run, --out of",
    ),
    OSError("Broken pipe\n\nCOMMAND:\nffmpeg"): (3, "output: Broken pipe COMMAND: ffmpeg. Write elsewhere"),
}


@pytest.mark.parametrize(("error", "ending"), ENDINGS.items(), ids=repr)
def test_an_error_that_the_user_can_solve_is_one_line_and_an_exit_code(error, ending) -> None:
    code, message = exit_codes.describe(error)
    assert (code, message[: len(ending[1])]) == ending


def test_a_reader_that_leaves_is_no_error(tmp_path: Path) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as gone:
        ended = subprocess.run([sys.executable, "-m", "clear_strategies.run", "--help"], stdout=gone, cwd=tmp_path,
                               env=environment(tmp_path), stderr=subprocess.PIPE, text=True, check=False)  # fmt: skip
    assert (ended.returncode, ended.stderr) == (141, "")
