"""The number of threads of compiled kernels, and the choice of the compiled module."""

from __future__ import annotations

from contextlib import suppress

import pytest
import torch

from rasterizers import BackendUnavailable, native


def test_kernels_use_as_many_threads_as_torch_outside_of_kernel_threads_which_an_error_leaves_too():
    before = torch.get_num_threads()
    assert native.threads() == before
    with suppress(RuntimeError), native.kernel_threads(3):
        assert (native.threads(), torch.get_num_threads()) == (3, 1)
        with native.kernel_threads(2):
            assert native.threads() == 2
        assert (native.threads(), torch.get_num_threads()) == (3, 1)
        raise RuntimeError
    assert (native.threads(), torch.get_num_threads()) == (before, before)


def test_without_compiled_kernels_the_error_says_what_to_install():
    with pytest.raises(BackendUnavailable, match=r"C\+\+20 compiler"):
        native.load_kernels("rasterizers.reference")


def test_an_instruction_set_that_the_processor_lacks_is_refused(monkeypatch):
    try:
        native.load_kernels("rasterizers.cpp")
    except BackendUnavailable as reason:
        pytest.skip(str(reason))
    with pytest.raises(BackendUnavailable, match="isa=z80 cannot run here"):
        native.load_kernels("rasterizers.cpp", "z80")
    monkeypatch.setenv("CLEAR_ISA", "z80")
    native.load_kernels.cache_clear()
    with pytest.raises(BackendUnavailable, match="CLEAR_ISA=z80"):
        native.load_kernels("rasterizers.cpp")
    native.load_kernels.cache_clear()
