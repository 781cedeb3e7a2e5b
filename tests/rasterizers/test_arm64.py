"""The kernels on arm64: compiled by a cross compiler and run by an emulator, where both are installed.

Debian: apt install g++-aarch64-linux-gnu qemu-user-static.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

_HERE = Path(__file__).parent
_ROOT = _HERE.parents[1]
_TOOLS = ("aarch64-linux-gnu-g++", "qemu-aarch64-static")
_INCLUDE = ("rasterizers/native/src", "rasterizers/cpp/src")
# As CMakeLists.txt, but for speed of compilation; CLEAR_DOUBLE leaves it to the compiler what to inline.
_FLAGS = (
    "-std=c++20",
    "-O1",
    "-DCLEAR_DOUBLE",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-pthread",
)

missing = [tool for tool in _TOOLS if shutil.which(tool) is None]


@pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")
def test_lanes_rows_and_a_frame_agree_on_arm64(tmp_path):
    compiler, emulator = _TOOLS
    folders = [f"-I{_ROOT / folder}" for folder in _INCLUDE]
    program = str(tmp_path / "checks")
    subprocess.run(
        [compiler, "-static", *_FLAGS, *folders, str(_HERE / "native_checks.cpp"), "-o", program], check=True
    )
    done = subprocess.run([emulator, program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout.startswith("ok")
