"""Who has the cores, and which kernels run on them."""

from __future__ import annotations

import pytest
import torch

from rasterizers import BackendUnavailable, native


def test_kernels_take_as_many_threads_as_torch_unless_they_own_the_cores():
    before = torch.get_num_threads()
    assert native.threads() == before
    with native.own_threads(3):
        assert (native.threads(), torch.get_num_threads()) == (3, 1)
        with native.own_threads(2):
            assert native.threads() == 2
        assert (native.threads(), torch.get_num_threads()) == (3, 1)
    assert (native.threads(), torch.get_num_threads()) == (before, before)


def test_the_cores_are_given_back_after_an_error():
    before = torch.get_num_threads()
    with pytest.raises(RuntimeError), native.own_threads(4):
        raise RuntimeError
    assert (native.threads(), torch.get_num_threads()) == (before, before)


def test_without_compiled_kernels_the_remedy_is_named():
    with pytest.raises(BackendUnavailable, match=r"C\+\+20 compiler"):
        native.load_kernels("rasterizers.reference")


def test_an_instruction_set_that_is_not_here_is_named(monkeypatch):
    try:
        native.load_kernels("rasterizers.cpp")
    except BackendUnavailable as reason:
        pytest.skip(str(reason))
    monkeypatch.setenv("CLEAR_ISA", "z80")
    native.load_kernels.cache_clear()
    with pytest.raises(BackendUnavailable, match="CLEAR_ISA=z80"):
        native.load_kernels("rasterizers.cpp")
    monkeypatch.delenv("CLEAR_ISA")
    native.load_kernels.cache_clear()
