"""The image losses in Warp: when they are used, and that blocks of many threads agree with one thread.

test_losses.py compares them with float64.
"""

from __future__ import annotations

import sys

import pytest
import torch
from torch._subclasses import FakeTensor, FakeTensorMode

from clear_strategies import Objective
from clear_strategies.kernels import losses
from clear_strategies.kernels.losses import cpp, warp
from rasterizers.interface import BackendUnavailable
from tests.helpers.loss_cases import LOSSES, needs_warp, photo, rough


@pytest.fixture
def uncached():
    """Clears what is cached about Warp, before and after the test."""
    for cached in (warp.available, warp.require):
        cached.cache_clear()
    yield
    for cached in (warp.available, warp.require):
        cached.cache_clear()


@pytest.fixture
def missing(monkeypatch, uncached):
    """No Warp here."""
    monkeypatch.setitem(sys.modules, "warp", None)  # makes its import fail


def on_cuda(dtype=torch.float32):
    """A fake image on CUDA, without data."""
    with FakeTensorMode() as mode:
        return FakeTensor(mode, torch.empty(4, 5, 3, dtype=dtype, device="meta"), torch.device("cuda:0"))


def test_auto_uses_warp_on_cuda_only(monkeypatch):
    x = torch.rand(4, 5, 3)
    monkeypatch.setattr(warp, "available", lambda device="cuda": True)
    assert losses._fastest(on_cuda(), on_cuda()) == "warp"
    assert losses._fastest(on_cuda(), x) == "torch"
    assert losses._fastest(on_cuda(torch.float64), on_cuda(torch.float64)) == "torch"
    assert losses._fastest(x, x) == ("cpp" if cpp.available() else "torch")
    assert losses.running_on("cuda") == ["warp", "torch"]
    assert "warp" not in losses.running_on("cpu")


def test_without_warp_torch_is_used_on_cuda(missing):
    assert losses._fastest(on_cuda(), on_cuda()) == "torch"
    assert losses.running_on("cuda") == ["torch"]


def test_without_warp_the_error_says_what_to_install(missing):
    with pytest.raises(BackendUnavailable, match=r"kernels=warp needs .*pip install 'clear-strategies\[warp\]'"):
        Objective(kernels="warp")


@needs_warp
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA")
def test_without_cuda_the_error_says_what_to_use(uncached):
    with pytest.raises(BackendUnavailable, match=r"kernels=warp cannot run on CUDA: .* kernels=torch runs here"):
        warp.require("cuda")


def test_images_on_a_cpu_do_not_import_warp(monkeypatch):
    monkeypatch.setattr(warp, "require", lambda device: pytest.fail("required Warp"))
    x, y = photo(20, 30), photo(20, 30, 6)
    assert losses.running_on()
    for loss in LOSSES.values():
        loss(x, y, "auto")
    Objective().hr(x, y)


@needs_warp
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_repeated_losses_have_the_same_bits(loss):
    x, y = rough(photo(61, 150), 0.1)
    value, gradient = loss(x, y, "warp")
    for _ in range(3):
        torch.full((1 << 20,), torch.nan)  # the allocator then reuses memory that is not zero
        again = loss(x, y, "warp")
        assert torch.equal(again.value, value)
        assert torch.equal(again.gradient, gradient)


@pytest.mark.slow
@needs_warp
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_blocks_of_many_threads_agree_with_one_thread(blocks_of, loss):
    from clear_strategies.kernels.losses.warp import launches

    x, y = rough(photo(15, 90), 0.1)
    alone = loss(x, y, "warp")
    blocks_of(launches.LANES, launches.LANES["cuda"])
    together = loss(x, y, "warp")
    assert float(together.value) == pytest.approx(float(alone.value), rel=1e-6)
    assert torch.allclose(together.gradient, alone.gradient, rtol=1e-5, atol=1e-6 * float(alone.gradient.abs().max()))


@pytest.mark.slow
@needs_warp
def test_the_kernels_compile_for_cuda_on_a_machine_without(ptx_of):
    from clear_strategies.kernels.losses.warp import haar, launches, similarity, sums

    lanes = launches.LANES["cuda"]
    by_lanes = (similarity.similarity, similarity.gradient, haar.details, sums.absolute, sums.total)
    for kernel in (haar.low_part, *(make(lanes) for make in by_lanes)):
        assert ".local" not in ptx_of(kernel.module, lanes)  # no spills: rows of numbers are in registers
