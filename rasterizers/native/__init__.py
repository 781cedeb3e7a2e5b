"""Loading of the compiled module for this processor's instruction set, the number of threads of its kernels, and their memory.

`src/` holds the C++ headers that both packages (`rasterizers.cpp` and `clear_strategies.kernels`) include.
"""

from __future__ import annotations

import hashlib
import importlib
import logging
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Final

import torch
from torch import Tensor
from torch.utils.dlpack import from_dlpack

from rasterizers.interface import BackendUnavailable, OutdatedKernels

_log = logging.getLogger(__name__)

_ISAS: Final = ("avx512", "avx2", "baseline")  # fastest first
_VARIABLE: Final = "CLEAR_ISA"  # of the environment, for tests and comparisons

_scopes: list[int] = []  # thread counts of the active `kernel_threads` scopes, innermost last


def threads() -> int:
    """The number of threads that compiled kernels use: that of the innermost `kernel_threads` scope, else torch's."""
    return _scopes[-1] if _scopes else torch.get_num_threads()


@contextmanager
def kernel_threads(n: int) -> Iterator[None]:
    """A scope in which compiled kernels use n threads and torch uses one.

    OpenMP threads, torch's included, spin for a while after each operation and would occupy the cores that the kernels
    need. Torch's operations between the kernels are small, and as fast on one thread.
    """
    before = torch.get_num_threads()
    _scopes.append(n)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _scopes.pop()
        torch.set_num_threads(before)


def _require_same_sources(package: str, module: ModuleType) -> None:
    """Refuse a module that CMake has made from other files than lie beside the package; in a wheel there are none."""
    folders = [
        Path(folder) / "src" for name in (package, __name__) for folder in importlib.import_module(name).__path__
    ]
    files = [file for folder in folders for file in sorted(folder.glob("*.[ch]pp"))]
    sums = "".join(hashlib.sha256(file.read_bytes()).hexdigest() for file in files)
    if files and hashlib.sha256(sums.encode()).hexdigest() != getattr(module, "sources", None):
        raise OutdatedKernels(
            f"the compiled kernels of {package} were made from other sources than those in {files[0].parent}, as after git pull. "
            "Install again: pip install -e ."
        )


@cache
def load_kernels(package: str, isa: str | None = None) -> ModuleType:
    """One of `package`'s modules `_avx512`, `_avx2` and `_baseline`.

    Args:
        isa: the instruction set; None: what `CLEAR_ISA` names, else the fastest that this processor can run.

    Raises:
        BackendUnavailable: none was compiled, or this processor cannot run the requested one.
        OutdatedKernels: they were compiled from other sources.
    """
    baseline = _baseline(package)
    if isinstance(baseline, ImportError):
        raise BackendUnavailable(
            f"the compiled kernels of {package} are not installed ({baseline}). This is a pure-Python installation, "
            "over twenty times slower on a CPU: install a C++20 compiler (Debian: apt install g++; macOS: xcode-select "
            "--install) and install clear-strategies again."
        ) from baseline
    _require_same_sources(package, baseline)
    supported = [*baseline.instruction_sets(), "baseline"]
    requested, source = isa or os.environ.get(_VARIABLE), "isa" if isa else _VARIABLE
    if requested and requested not in supported:
        raise BackendUnavailable(f"{source}={requested} cannot run here; this processor has {', '.join(supported)}.")
    for name in [requested] if requested else [name for name in _ISAS if name in supported]:
        try:
            module = importlib.import_module(f"{package}._{name}")
        except ImportError as error:
            _log.warning("%s was not compiled for %s: %s", package, name, error)
            continue
        _log.debug("%s: kernels for %s.", package, name)
        return module
    raise BackendUnavailable(f"{package} was not compiled for {requested}; unset {source}.")


@cache
def _baseline(package: str) -> ModuleType | ImportError:
    """The module that runs on each processor, or why there is none: a failing import costs as much each time, and `empty_for`
    asks for every tensor.
    """
    try:
        return importlib.import_module(f"{package}._baseline")
    except ImportError as error:
        return error.with_traceback(None)


def empty(shape: Sequence[int], dtype: torch.dtype = torch.float32) -> Tensor:
    """Not initialized, in the CPU's memory that another such tensor has left: fresh pages cost more than filling them."""
    numbers = math.prod(shape) * dtype.itemsize // torch.float32.itemsize
    x: Tensor = from_dlpack(load_kernels("rasterizers.cpp").Frame.empty((numbers,)))
    return x.view(dtype).view(*shape)


def empty_for(like: Tensor, shape: Sequence[int] | None = None) -> Tensor:
    """Not initialized, contiguous, of this one's type and on its device; by `empty` where the kernels take such tensors.

    Args:
        shape: None: that of `like`.
    """
    shape = like.shape if shape is None else shape
    if like.device.type == "cpu" and like.dtype in (torch.float32, torch.float64):
        with suppress(BackendUnavailable):
            return empty(shape, like.dtype)
    return like.new_empty(shape)


def release() -> None:
    """Give the system the memory that `empty` and the frames keep for their next use: as much as an iteration needs."""
    with suppress(BackendUnavailable):
        load_kernels("rasterizers.cpp").Frame.release()
