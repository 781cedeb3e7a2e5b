"""Fixtures shared by all tests."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

import pytest
import torch

# Small tensors: a second thread costs more than it brings, above all beside other test processes.
torch.set_num_threads(1)


class _KernelsAsWritten:
    """Finds modules with Warp's kernels before jaxtyping's import hook does, which would wrap them: Warp reads their source."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(name, path) if ".warp" in name else None
        written = spec is not None and spec.origin is not None and "\n@wp." in Path(spec.origin).read_text()
        return spec if written else None


def pytest_sessionstart() -> None:
    sys.meta_path.insert(0, _KernelsAsWritten)


def pytest_collection_finish() -> None:
    """From here on no bytecode is written. While two threads import, jaxtyping's import hook may write its own code where Python
    looks for plain code, and every later process that imports it without the hook fails.
    """
    sys.dont_write_bytecode = True


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The real scenes beside a developer's checkout; tests that need them skip where they are absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("real scenes are not here: ../shared/data is absent")
    return folder
