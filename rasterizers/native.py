"""Compiled kernels: which instruction set this processor has, the module that was built for it, and how many threads."""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Final

import torch

from rasterizers.interface import BackendUnavailable

_log = logging.getLogger(__name__)

_ISAS: Final = ("avx512", "avx2", "baseline")  # best first
_OVERRIDE: Final = "CLEAR_ISA"  # for tests and comparisons

_owned: list[int] = []


def threads() -> int:
    """How many threads kernels use: as many as torch, unless somebody holds `own_threads`."""
    return _owned[-1] if _owned else torch.get_num_threads()


@contextmanager
def own_threads(n: int) -> Iterator[None]:
    """The cores belong to the kernels: they use n threads, torch uses one.

    OpenMP's threads, torch's too, wait by spinning: for a while after each of its operations torch would keep every
    core but one from our own threads. With the kernels doing the work, its small operations are as fast on one.
    """
    before = torch.get_num_threads()
    _owned.append(n)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _owned.pop()
        torch.set_num_threads(before)


@cache
def load_kernels(package: str) -> ModuleType:
    """The fastest of `package`'s modules `_avx512`, `_avx2`, `_baseline` that this processor runs.

    Raises:
        BackendUnavailable: none was built, or `CLEAR_ISA` names one that cannot run here.
    """
    try:
        baseline = importlib.import_module(f"{package}._baseline")
    except ImportError as error:
        raise BackendUnavailable(
            f"the compiled kernels of {package} are not installed ({error}). This is a pure-Python installation: install a "
            "C++20 compiler (Debian: apt install g++; macOS: xcode-select --install) and install clear-strategies again."
        ) from error
    runs_here = [*baseline.instruction_sets(), "baseline"]
    wanted = os.environ.get(_OVERRIDE)
    if wanted and wanted not in runs_here:
        raise BackendUnavailable(f"{_OVERRIDE}={wanted} cannot run here; this processor has {', '.join(runs_here)}.")
    for isa in [wanted] if wanted else [isa for isa in _ISAS if isa in runs_here]:
        try:
            module = importlib.import_module(f"{package}._{isa}")
        except ImportError as error:
            _log.warning("%s was not built for %s: %s", package, isa, error)
            continue
        _log.debug("%s: kernels for %s.", package, isa)
        return module
    raise BackendUnavailable(f"{package} was not built for {wanted}; unset {_OVERRIDE}.")
