"""The C++ sources with other compilers than the one here, where they are installed.

Clang, which macOS builds with, refuses some of what GCC accepts. For arm64 a cross compiler builds the kernels and an emulator
runs them. Debian: apt install clang g++-aarch64-linux-gnu qemu-user-static.
"""

import shutil
import subprocess
from pathlib import Path

import pytest

_ROOT = Path(__file__).resolve().parents[2]
_KERNELS = "clear_strategies/kernels/src"
_INCLUDES = [f"-I{_ROOT / folder}" for folder in ("rasterizers/native/src", "rasterizers/cpp/src", _KERNELS)]
_CHECKS = "tests/rasterizers/native_checks.cpp"
_CLANG = next(filter(None, map(shutil.which, ("clang++", *(f"clang++-{n}" for n in range(21, 13, -1))))), None)
_ARM64 = ("aarch64-linux-gnu-g++", "qemu-aarch64-static")
# As CMakeLists.txt, but for speed of compilation; CLEAR_DOUBLE leaves it to the compiler what to inline.
_FLAGS = ("-O1", "-DCLEAR_DOUBLE", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-pthread")


@pytest.mark.skipif(_CLANG is None, reason="not installed: clang++")
@pytest.mark.parametrize("source", [_CHECKS, *(f"{_KERNELS}/{n}" for n in ("step.cpp", "photometric.hpp", "haar.hpp"))])
def test_it_compiles_with_clang(source):
    command = [str(_CLANG), "-x", "c++", "-std=c++20", "-fsyntax-only", *_INCLUDES, str(_ROOT / source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not all(map(shutil.which, _ARM64)), reason=f"not installed: {' or '.join(_ARM64)}")
def test_lanes_rows_and_a_frame_agree_on_arm64(tmp_path):
    (compiler, emulator), program = _ARM64, str(tmp_path / "checks")
    command = [compiler, "-static", "-std=c++20", *_FLAGS, *_INCLUDES, str(_ROOT / _CHECKS), "-o", program]
    subprocess.run(command, check=True)
    done = subprocess.run([emulator, program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout.startswith("ok")
