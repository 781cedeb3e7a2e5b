"""Fixtures shared by all tests."""

import gc
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

import jaxtyping
import pytest
import torch
import typecheck

jaxtyping.jaxtyped = typecheck.checked_once

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
    gc.freeze()  # a collection would look through torch's modules and all tests, a million objects that stay


def pytest_runtest_setup() -> None:
    """What a test draws without a generator does not depend on the tests before it, which are others in each worker."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The real scenes beside a developer's checkout; tests that need them skip where they are absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("real scenes are not here: ../shared/data is absent")
    return folder


@pytest.fixture(scope="module")
def saved_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """The folder of a small run as it was saved, and its field."""
    from tests.helpers import saved_run

    folder = tmp_path_factory.mktemp("run")
    return folder, saved_run.write(folder)


@pytest.fixture
def whole_blocks(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Called, lets kernels run with as many threads per block as on CUDA, where lanes sum together."""
    import warp as wp

    if not hasattr(wp.config, "enable_cpu_blocks"):
        pytest.skip("this Warp has no blocks of several threads on a CPU")

    return lambda: monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)


@pytest.fixture(params=[80, 120], ids="sm_{}".format)
def ptx_of(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str]:
    """Compiles the module of a kernel for CUDA, with `lanes` threads per block or Warp's own number; returns its assembly.

    For two kinds of GPU: NVRTC's older compiler writes the same code for sm_80 and sm_90, and its newer one that of sm_120.
    Warp brings both: they need neither a GPU nor a driver.
    """
    if sys.platform == "darwin":
        pytest.skip("Warp for macOS brings no compiler for CUDA")
    import warp as wp

    def compiled(module: Any, lanes: int | None = None) -> str:
        if lanes is not None:
            monkeypatch.setitem(module.options, "block_dim", lanes)
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        wp.compile_aot_module(module, arch=request.param, module_dir=folder, use_ptx=True)
        (file,) = folder.glob("*.ptx")
        assembly = file.read_text()
        assert f".target sm_{request.param}" in assembly
        return assembly

    return compiled


@pytest.fixture
def strict_cuda(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The CPU stands in for a CUDA device, see `tests.helpers.strict_cuda`."""
    pytest.importorskip("warp")
    from tests.helpers import strict_cuda

    with strict_cuda.installed(monkeypatch) as cuda:
        yield cuda


@pytest.fixture(params=["stand-in", "cuda"])
def recorded_on(request: pytest.FixtureRequest) -> torch.device:
    """A device that records: the CPU that stands in for one, and a GPU."""
    if request.param == "stand-in":
        request.getfixturevalue("strict_cuda")
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return torch.device("cuda")
