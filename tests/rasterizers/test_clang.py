"""The C++ sources compile with Clang, which macOS builds with, and which refuses some of what GCC accepts.

Debian: apt install clang.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

_ROOT = Path(__file__).resolve().parents[2]
_KERNELS = "clear_strategies/kernels/src"
_FOLDERS = ("rasterizers/native/src", "rasterizers/cpp/src", _KERNELS)
_COMPILER = next(filter(None, map(shutil.which, ("clang++", *(f"clang++-{n}" for n in range(21, 13, -1))))), None)


@pytest.mark.skipif(_COMPILER is None, reason="not installed: clang++")
@pytest.mark.parametrize(
    "source",
    [
        "tests/rasterizers/native_checks.cpp",
        f"{_KERNELS}/step.cpp",
        f"{_KERNELS}/photometric.hpp",
        f"{_KERNELS}/haar.hpp",
    ],
)
def test_it_compiles(source):
    flags = ["-x", "c++", "-std=c++20", "-fsyntax-only"]
    folders = [f"-I{_ROOT / folder}" for folder in _FOLDERS]
    done = subprocess.run(
        [str(_COMPILER), *flags, *folders, str(_ROOT / source)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
