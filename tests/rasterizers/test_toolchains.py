"""The C++ sources with other compilers than the one here, where they are installed.

Clang, which macOS builds with, refuses some of what GCC accepts. For arm64 a cross compiler builds the kernels and an emulator
runs them. Debian: apt install clang g++-aarch64-linux-gnu qemu-user-static.
"""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

_KERNELS = "clear_strategies/kernels/src"
_INCLUDES = [f"-I{ROOT / folder}" for folder in ("rasterizers/native/src", "rasterizers/cpp/src", _KERNELS)]
_CHECKS = "tests/rasterizers/native_checks.cpp"
_RESULTS = ("tests/kernels/native_results.cpp", f"{_KERNELS}/step.cpp", f"{_KERNELS}/reconcile.cpp")
_TYPES = next(Path("/usr").glob("include/**/bits/types.h"), None)  # glibc's; none on macOS
_CLANG = next(filter(None, map(shutil.which, ("clang++", *(f"clang++-{n}" for n in range(21, 13, -1))))), None)
_ARM64 = ("aarch64-linux-gnu-g++", "qemu-aarch64-static")
# As CMakeLists.txt, but for speed of compilation; CLEAR_DOUBLE leaves it to the compiler what to inline.
_FLAGS = ("-Og", "-DCLEAR_DOUBLE", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-pthread")


@pytest.mark.skipif(_CLANG is None, reason="not installed: clang++")
@pytest.mark.parametrize("source", [_CHECKS, *_RESULTS])
def test_it_compiles_with_clang_where_int64_is_long_long(source, tmp_path):
    """As on macOS: there std::min does not take an std::int64_t together with an std::ptrdiff_t, which is long."""
    if _TYPES is not None:
        (tmp_path / "bits").mkdir()
        types = re.sub(r"\blong int (__u?int64_t;)", r"long long int \1", _TYPES.read_text())
        (tmp_path / "bits" / "types.h").write_text(types)
    includes = [f"-I{tmp_path}", *_INCLUDES]
    command = [str(_CLANG), "-x", "c++", "-std=c++20", "-fsyntax-only", *includes, str(ROOT / source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def built(compiler, program, *arguments):
    """The path of a program of these sources, which needs nothing beside it."""
    subprocess.run(
        [compiler, "-static", "-std=c++20", *_FLAGS, *_INCLUDES, *arguments, "-o", program], check=True, cwd=ROOT
    )
    return str(program)


@pytest.mark.skipif(not all(map(shutil.which, _ARM64)), reason=f"not installed: {' or '.join(_ARM64)}")
def test_lanes_rows_and_a_frame_agree_on_arm64(tmp_path):
    compiler, emulator = _ARM64
    program = built(compiler, tmp_path / "checks", _CHECKS)
    done = subprocess.run([emulator, program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout.startswith("ok")


@pytest.mark.skipif(
    not all(map(shutil.which, ("g++", *_ARM64))), reason=f"not installed: {' or '.join(('g++', *_ARM64))}"
)
@pytest.mark.slow
def test_the_kernels_have_the_same_bits_on_arm64(tmp_path):
    """Without fused multiplication, and with registers of one size, both processors compute the same sums in the same order."""
    printed = []
    for compiler, *emulator in (("g++",), _ARM64):
        program = built(compiler, tmp_path / compiler, "-O2", "-ffp-contract=off", *_RESULTS)
        done = subprocess.run([*emulator, program], capture_output=True, text=True, check=True)
        printed.append(done.stdout.splitlines())
    here, there = printed
    assert len(here) > 30
    assert "nan" not in " ".join(here)
    assert [line.split()[0] for line in here] == [line.split()[0] for line in there]
    assert [a.split()[0] for a, b in zip(here, there, strict=True) if a != b] == []
