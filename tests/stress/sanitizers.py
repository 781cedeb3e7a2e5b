"""The C++ kernels under the address and the undefined-behaviour sanitizer: compiled anew, then run by their own tests.

`python -m tests.stress --only sanitizers` does this, with CMake and g++ installed. The build goes to a folder of its own.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rasterizers.native import load_kernels
from tests.stress.rows import Row

_log = logging.getLogger("tests.stress")

_ROOT = Path(__file__).resolve().parents[2]
_SANITIZERS = "address,undefined"
_PACKAGES = ("rasterizers/cpp", "clear_strategies/kernels")
# Every kernel: projection, blending, gradients and depth; the losses; the per-Gaussian step.
_TESTS = (
    "tests/rasterizers/test_cpp.py", "tests/rasterizers/test_depth.py", "tests/rasterizers/test_splats_contract.py",
    "tests/kernels/test_losses.py", "tests/training/test_compiled_step.py",
)  # fmt: skip
_FINDING = re.compile(r"ERROR: AddressSanitizer.*|[^\n]*runtime error: .*")
_NATIVE = ("rasterizers/native/src", "rasterizers/cpp/src")


def why_not() -> str | None:
    """Why the sanitizers cannot run here; None: they can."""
    missing = [tool for tool in ("cmake", "g++", "git") if shutil.which(tool) is None]
    return f"{', '.join(missing)} not installed" if missing else None


def measure(folder: Path, isas: Sequence[str] | None = None) -> list[Row]:
    """One row per instruction set, and one of the checks without Python.

    Args:
        isas: None: all that this processor runs.
    """
    chosen = dict.fromkeys(isas or [*load_kernels("rasterizers.cpp").instruction_sets(), "baseline"])
    return [_native_checks(folder), *(_tests(folder, isa) for isa in chosen)]


def _native_checks(folder: Path) -> Row:
    program = folder / "native_checks"
    flags = ["-std=c++20", "-O1", "-g", "-march=native", f"-fsanitize={_SANITIZERS}", "-ffp-contract=fast", "-pthread"]
    includes = [f"-I{_ROOT / path}" for path in _NATIVE]
    source = _ROOT / "tests" / "rasterizers" / "native_checks.cpp"
    subprocess.run(["g++", *flags, *includes, str(source), "-o", str(program)], check=True)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False, env=_environment())
    return _row("native_checks.cpp", 1, done)


def _tests(folder: Path, isa: str) -> Row:
    tree = folder / f"tree_{isa}"
    for name in _output("git", "ls-files").split("\n"):
        if name and (_ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(_ROOT / name, tree / name)
    build = folder / "build"
    nanobind = _output(sys.executable, "-m", "nanobind", "--cmake_dir")
    configure = [
        f"-DCLEAR_SANITIZE={_SANITIZERS}", f"-Dnanobind_DIR={nanobind}", f"-DPython_EXECUTABLE={sys.executable}",
    ]  # fmt: skip
    subprocess.run(["cmake", "-S", str(_ROOT), "-B", str(build), *configure], check=True, stdout=subprocess.DEVNULL)
    for package in _PACKAGES:
        target = f"{package.replace('/', '_')}_{isa}"
        _log.info("sanitizers: compiling %s …", target)
        subprocess.run(["cmake", "--build", str(build), "--target", target], check=True, stdout=subprocess.DEVNULL)
        for module in (build / package).glob(f"_{isa}*"):
            shutil.copy(module, tree / package / module.name)
    _log.info("sanitizers: testing %s …", isa)
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "", "-p", "no:cacheprovider", *_TESTS]
    environment = _environment(CLEAR_ISA=isa, PYTHONPATH=str(tree), LD_PRELOAD=_runtimes())
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False, env=environment)
    counted = re.search(r"(\d+) passed", done.stdout)
    return _row(isa, int(counted[1]) if counted else 0, done)


def _row(backend: str, cases: int, done: subprocess.CompletedProcess[str]) -> Row:
    output = done.stdout + done.stderr
    found = _FINDING.findall(output)
    if done.returncode and not found:
        found = [output.strip().split("\n")[-1]]
    where = found[0].strip()[:160].replace("|", "/") if found else "none"
    return Row("C++ under ASan and UBSan: findings", backend, cases, float(len(found)), 0, where)


def _environment(**more: str) -> dict[str, str]:
    """Python itself leaks by design, and a test asks for more memory than there is."""
    options = {
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1",
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "OMP_NUM_THREADS": "1",
    }
    return {**os.environ, **options, **more}


def _runtimes() -> str:
    """Loaded before Python, which was built without them."""
    return ":".join(_output("g++", f"-print-file-name=lib{name}.so") for name in ("asan", "ubsan", "stdc++"))


def _output(*command: str) -> str:
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()
