"""The image losses on Warp: where they are taken, and that a GPU's blocks find what one thread finds.

What they find is held against float64 in `test_kernels`.
"""

from __future__ import annotations

import builtins
import sys

import pytest
import torch
from torch._subclasses import FakeTensor, FakeTensorMode

from clear_strategies import Objective
from clear_strategies.kernels import losses
from clear_strategies.kernels.losses import cpp, warp
from rasterizers.interface import BackendUnavailable
from tests.kernels.test_losses import TRAINED_WITH, needs_warp, photo, rough


@pytest.fixture
def forgotten():
    """Nothing is known about Warp, before and after."""
    for known in (warp.available, warp.needed):
        known.cache_clear()
    yield
    for known in (warp.available, warp.needed):
        known.cache_clear()


@pytest.fixture
def missing(monkeypatch, forgotten):
    """No Warp here."""
    real = builtins.__import__

    def imported(name, *arguments, **options):
        if name == "warp":
            raise ModuleNotFoundError("No module named 'warp'", name="warp")
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", imported)


def on_cuda(dtype=torch.float32):
    """An image whose device says CUDA; nobody may look into it."""
    with FakeTensorMode() as mode:
        return FakeTensor(mode, torch.empty(4, 5, 3, dtype=dtype, device="meta"), torch.device("cuda:0"))


def test_auto_takes_warp_on_cuda_alone(monkeypatch):
    x = torch.rand(4, 5, 3)
    monkeypatch.setattr(warp, "available", lambda device="cuda": True)
    assert losses._fastest(on_cuda(), on_cuda()) == "warp"
    assert losses._fastest(on_cuda(), x) == "torch"
    assert losses._fastest(on_cuda(torch.float64), on_cuda(torch.float64)) == "torch"
    assert losses._fastest(x, x) == ("cpp" if cpp.available() else "torch")
    assert list(losses.implementations("cuda")) == ["warp", "torch"]
    assert "warp" not in losses.implementations("cpu")


def test_without_warp_torch_does_it_on_cuda(missing):
    assert losses._fastest(on_cuda(), on_cuda()) == "torch"
    assert list(losses.implementations("cuda")) == ["torch"]


def test_without_warp_the_remedy_is_named(missing):
    with pytest.raises(
        BackendUnavailable, match=r"kernels=warp needs .* not installed .*pip install 'clear-strategies\[warp\]'"
    ):
        Objective(kernels="warp")


@needs_warp
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA")
def test_without_cuda_the_remedy_is_named(forgotten):
    with pytest.raises(BackendUnavailable, match=r"kernels=warp cannot run on CUDA: .* kernels=torch runs here"):
        warp.needed("cuda")


def test_images_on_a_cpu_never_ask_for_warp(monkeypatch):
    monkeypatch.setattr(warp, "needed", lambda device: pytest.fail("asked for Warp"))
    x, y = photo(20, 30), photo(20, 30, 6)
    assert losses.implementations()
    for loss in TRAINED_WITH.values():
        loss(x, y, "auto")
    Objective().hr(x, y)


@needs_warp
def test_the_objective_is_the_same_by_warp():
    x, y = rough(photo(60, 70), 0.1)
    fast, slow = (Objective(kernels=name, haar_levels=2).hr(x, y) for name in ("warp", "torch"))
    assert fast.values == pytest.approx(slow.values, abs=1e-6)
    assert torch.allclose(fast.cotangents, slow.cotangents, rtol=1e-4, atol=1e-5 * float(slow.cotangents.abs().max()))


@needs_warp
@pytest.mark.parametrize("loss", TRAINED_WITH.values(), ids=TRAINED_WITH)
def test_the_bits_are_the_same_again(loss):
    x, y = rough(photo(61, 150), 0.1)
    value, gradient = loss(x, y, "warp")
    for _ in range(3):
        torch.full((1 << 20,), torch.nan)  # other memory is free, and none of it zero
        again = loss(x, y, "warp")
        assert torch.equal(again.value, value)
        assert torch.equal(again.gradient, gradient)


@needs_warp
@pytest.mark.parametrize("loss", TRAINED_WITH.values(), ids=TRAINED_WITH)
def test_a_block_of_threads_finds_what_one_thread_finds(monkeypatch, loss):
    """The losses as CUDA runs them, 256 threads a block: on a CPU, where Warp can imitate them."""
    import warp as wp

    from clear_strategies.kernels.losses.warp import launches

    if not hasattr(wp.config, "enable_cpu_blocks"):
        pytest.skip("this Warp has no blocks of several threads on a CPU")
    x, y = rough(photo(15, 90), 0.1)
    alone = loss(x, y, "warp")
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    monkeypatch.setitem(launches._LANES, "cpu", launches._LANES["cuda"])
    together = loss(x, y, "warp")
    assert float(together.value) == pytest.approx(float(alone.value), rel=1e-6)
    assert torch.allclose(together.gradient, alone.gradient, rtol=1e-5, atol=1e-6 * float(alone.gradient.abs().max()))


@needs_warp
@pytest.mark.skipif(sys.platform == "darwin", reason="Warp for macOS brings no compiler for CUDA")
def test_the_kernels_compile_for_cuda_without_one(monkeypatch, tmp_path):
    import warp as wp

    from clear_strategies.kernels.losses.warp import haar, launches, similarity, sums

    lanes = launches._LANES["cuda"]
    made = (similarity.similarity, similarity.gradient, haar.details, sums.absolute, sums.total)
    for kernel in (haar.low_part, *(make(lanes) for make in made)):
        monkeypatch.setitem(kernel.module.options, "block_dim", lanes)
        wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path / kernel.key, use_ptx=True)
        (compiled,) = (tmp_path / kernel.key).glob("*.ptx")
        code = compiled.read_text()
        assert ".target sm_90" in code
        assert ".local" not in code  # rows of numbers are registers
