"""The backend "cpp" alone: its instruction sets, its threads and its memory budget."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest

import rasterizers
from rasterizers import BackendUnavailable, native
from rasterizers.cpp import CppRasterizer
from rasterizers.testing import check_rasterizer, scene
from tests.helpers.agreement import require_same_bits
from tests.helpers.backends import camera, cotangents, dense_scene, everything, why_not

pytestmark = pytest.mark.skipif(bool(why_not("cpp")), reason=str(why_not("cpp")))


def cpp(**settings):
    return rasterizers.load("cpp", **settings)


@pytest.fixture(params=["baseline", "avx2", "avx512"])
def isa(request):
    """An instruction set that this processor has."""
    if request.param not in [*native.load_kernels("rasterizers.cpp").instruction_sets(), "baseline"]:
        pytest.skip(f"this processor has no {request.param}")
    return request.param


def test_every_instruction_set_passes_the_checks(isa):
    assert cpp(isa=isa).module == isa
    check_rasterizer(functools.partial(CppRasterizer, isa=isa))


def test_an_instruction_set_that_the_processor_lacks_is_refused():
    with pytest.raises(BackendUnavailable, match="isa=z80 cannot run here"):
        cpp(isa="z80")


def test_bits_do_not_depend_on_threads(isa):
    splats, view = dense_scene()
    v = cotangents(3, 97, 130)
    expected = everything(cpp(threads=1, isa=isa)(splats, view), v)
    for threads in (2, 3, 4, 8):
        for _ in range(2):
            require_same_bits(everything(cpp(threads=threads, isa=isa)(splats, view), v), expected)


def test_bits_do_not_depend_on_the_memory_budget():
    splats, view = scene(2000, bands=3, seed=2), camera(1000, 700)
    splats = replace(splats, scales=splats.scales * 3)
    v = cotangents(2, 700, 1000)
    one_band = everything(cpp()(splats, view), v)
    bands = cpp(memory=4)(splats, view)
    assert bands._frame.native.pairs(0) * 16 > 4 << 20  # it needs several bands
    require_same_bits(everything(bands, v), one_band)


def test_threads_out_of_range_are_refused():
    with pytest.raises(ValueError, match="at least 1"):
        cpp(threads=0)
