"""What only the per-Gaussian pass in Warp has to show; that it computes what C++ does is in test_fused.py."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from clear_strategies import GCO, P2G, SVS, Conductor
from clear_strategies.training.compiled_step import CompiledStep, compiled_step_for, gaussian_pass
from clear_strategies.training.optim import Adam, LearningRates
from rasterizers.interface import BackendUnavailable
from rasterizers.warp_backend.launch import require
from tests.training.test_compiled_step import Case, T, case, conductors, told


@pytest.fixture
def warp_step():
    try:
        require("the compiled pass", "cpu", "")
    except BackendUnavailable as reason:
        pytest.skip(str(reason))

    from clear_strategies.kernels.gaussian_step import warp

    return warp


def started(warp_step, **settings) -> tuple[Case, CompiledStep]:
    """Everything at once, with rows and bands that rest, and rows that nobody sees."""
    c = case(1000, degree=2, kind="sparse")
    _, conductor = conductors(lambda: GCO(**settings), P2G, SVS, anchored=c.fields[0])
    adam = Adam(c.fields[1].raw(), LearningRates(detail_decay=0.1, rows="visible"), 1.0)
    return c, CompiledStep(conductor, adam, passes=warp_step.GaussianPass)


def two_steps(warp_step):
    """Parameters and moments, conflicts and readings, and the work_log's counts."""
    c, step = started(warp_step)
    conflicts = [told(step.step(c.fields[1].raw(), *c.factors(1), T + i)) for i in range(2)]
    state = [*c.fields[1].raw().values(), *step.optimizer.first.values(), *step.optimizer.second.values()]
    numbers = told(step.conductor.logs())
    return state, conflicts, numbers, step.conductor.work_log.entries["optimizer rows"].skipped


def test_blocks_of_many_threads_find_what_one_thread_finds(warp_step, monkeypatch):
    """As on CUDA: lanes that add up together, the last block of them half empty; on a CPU, where Warp can imitate it."""
    import warp as wp

    if not hasattr(wp.config, "enable_cpu_blocks"):
        pytest.skip("this Warp has no blocks of several threads on a CPU")
    state, conflicts, readings, skipped = two_steps(warp_step)
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    monkeypatch.setitem(warp_step.LANES, "cpu", 128)
    again = two_steps(warp_step)
    assert all(torch.equal(a, b) for a, b in zip(state, again[0], strict=True))
    assert again[1] == conflicts
    assert again[2] == pytest.approx(readings, rel=1e-12)
    assert again[3] == skipped
    assert all(skipped.values())


class Asked(TorchDispatchMode):
    """What makes the host wait for a device, had the tensors been there."""

    WAITING = ("aten::_local_scalar_dense", "aten::nonzero", "aten::equal", "aten::_to_copy", "aten::masked_select")

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name
        masked = name == "aten::index" and any(i is not None and i.dtype == torch.bool for i in args[1])
        if name in self.WAITING or masked:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("eps", ["relative:1e-12", "absolute:0"])
def test_nobody_waits_for_the_device(warp_step, eps):
    c, step = started(warp_step, eps=eps)
    factors = c.factors(1)
    step.step(c.fields[1].raw(), *factors, T)  # looks at what changes with the structure only
    with Asked() as asked:
        conflict = step.step(c.fields[1].raw(), *factors, T + 1)
    assert asked.found == []
    assert all(0 <= share <= 1 for share in told(conflict).values())


@pytest.fixture
def adam_on_cuda() -> Adam:
    """As far as it says where its moments lie."""
    adam = Adam({}, LearningRates(), 1.0)
    adam.first = {"means": SimpleNamespace(device=torch.device("cuda"), dtype=torch.float32)}
    return adam


def test_on_cuda_the_pass_is_warps(warp_step, adam_on_cuda, monkeypatch):
    asked = []
    monkeypatch.setattr("clear_strategies.training.compiled_step.require", lambda *arguments: asked.append(arguments))
    assert gaussian_pass(adam_on_cuda) is warp_step.GaussianPass
    assert [device for _, device, _ in asked] == ["cuda"]


def test_on_cuda_without_warp_the_readable_path_is_taken_and_that_is_said(adam_on_cuda, monkeypatch, caplog):
    def missing(what, device, otherwise):
        raise BackendUnavailable(f"{what} needs NVIDIA Warp, which is not installed.")

    monkeypatch.setattr("clear_strategies.training.compiled_step.require", missing)
    with caplog.at_level("INFO"):
        assert compiled_step_for(Conductor(), adam_on_cuda) is None
    assert caplog.messages == [
        "The per-Gaussian step takes the readable path: the compiled pass needs NVIDIA Warp, which is not installed."
    ]


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp for macOS brings no compiler for CUDA")
def test_the_kernels_compile_for_cuda_without_one(warp_step, monkeypatch, tmp_path):
    import warp as wp

    module = warp_step.sweeps.step.module  # all three
    monkeypatch.setitem(module.options, "block_dim", warp_step.LANES["cuda"])
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    (compiled,) = tmp_path.glob("*.ptx")
    assembly = compiled.read_text()
    assert ".target sm_90" in assembly
    assert ".local" not in assembly  # everything of a thread is in registers
    assert "fma.rn.f32" not in assembly  # products and sums round as they do in torch
