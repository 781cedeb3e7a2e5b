"""The backend "cpp" alone: its instruction sets, its threads and its memory budget."""

from contextlib import suppress
from dataclasses import fields, replace

import pytest
import torch

import rasterizers
from clear_strategies.jobs import exit_codes
from clear_strategies.kernels import native as strategies_native
from rasterizers import BackendUnavailable, Camera, Splats, native
from rasterizers.interface import OutdatedKernels
from rasterizers.reference.projection import footprints
from rasterizers.testing import scene
from tests.helpers.backends import camera, cotangents, dense_scene, everything, needs, require_same_bits

pytestmark = needs("cpp")


def cpp(**settings):
    return rasterizers.load("cpp", **settings)


@pytest.fixture(params=["baseline", "avx2", "avx512"])
def isa(request):
    """An instruction set that this processor has."""
    if request.param not in [*native.load_kernels("rasterizers.cpp").instruction_sets(), "baseline"]:
        pytest.skip(f"this processor has no {request.param}")
    return request.param


def test_bits_do_not_depend_on_threads(isa):
    assert cpp(isa=isa).module == isa
    splats, view = dense_scene()
    v = cotangents(3, 97, 130)
    expected = everything(cpp(threads=1, isa=isa)(splats, view, depth=True), v)
    for threads in (2, 3, 4, 8, 8):
        require_same_bits(everything(cpp(threads=threads, isa=isa)(splats, view, depth=True), v), expected)


def test_bits_do_not_depend_on_the_memory_budget():
    splats, view = scene(2000, bands=3, seed=2), camera(1000, 700)
    splats = replace(splats, scales=splats.scales * 3)
    v = cotangents(2, 700, 1000)
    one_band = everything(cpp()(splats, view, depth=True), v)
    bands = cpp(memory=4, threads=3)(splats, view, depth=True)
    assert bands._frame.native.pairs(0) * 16 > 4 << 20  # it needs several bands
    require_same_bits(everything(bands, v), one_band)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-4), (torch.float64, 1e-12)])
def test_shears_are_those_of_the_reference_and_0_where_nothing_is_seen(dtype, tolerance):
    splats = scene(500, bands=0, seed=2)
    splats = Splats(*(x.to(dtype) for x in (getattr(splats, f.name) for f in fields(splats)) if x is not None))
    drawn, visible = cpp()(splats, camera()), cpp()(splats, camera()).visible
    shapes = (x[visible].double() for x in (splats.means, splats.quats, splats.scales))
    expected = footprints(*shapes, camera(), cpp().kernel).shears
    assert 0 < len(expected) < 500
    assert torch.allclose(drawn.shears[visible].double(), expected, rtol=tolerance, atol=tolerance)
    assert not drawn.shears[~visible].any()


def covering(n):
    """Gaussians that each cover the whole image."""
    splats = scene(n, bands=0, seed=2)
    return replace(splats, scales=torch.full_like(splats.scales, 50.0), opacities=torch.full((n,), 0.01))


def test_a_row_beyond_the_budget_is_drawn_in_parts_and_what_gradients_cannot_have_is_refused_at_first():
    splats, view = covering(3000), camera(400, 40)
    v = cotangents(3, 40, 400)
    assert 3000 * 13 * 16 < 1 << 20 < 3000 * 13 * (16 + 3 * 64)  # a row of bins fits forward, and not backward
    parts = everything(cpp(memory=1)(splats, view), v)
    require_same_bits(parts, everything(cpp()(splats, view), v))
    splats, view = covering(9000), camera(64, 40)
    with pytest.raises(MemoryError, match=r"one bin of 32 px holds 9000 Gaussians, whose image and gradients need 2"):
        cpp(memory=1)(splats, view)
    cpp(memory=2)(splats, view).vjp(cotangents(3, 40, 64))


@pytest.mark.parametrize("size", [(1 << 20, 1), (1, 1 << 20)])
def test_the_longest_side_is_drawn_and_a_longer_one_refused(size):
    splats = covering(3)
    drawn = cpp()(splats, Camera(torch.eye(4), 10.0, 10.0, 1.0, 1.0, *size)).alpha
    assert float(drawn.flatten()[0]) > 0
    assert float(drawn.flatten()[-1]) == 0  # the far end sees past them
    with pytest.raises(ValueError, match="up to 1048576 px a side"):
        cpp()(splats, Camera(torch.eye(4), 10.0, 10.0, 1.0, 1.0, *(side + (side > 1) for side in size)))


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


def look_anew():
    native.load_kernels.cache_clear()
    native._baseline.cache_clear()


def test_compiled_kernels_that_are_missing_are_looked_for_once(monkeypatch):
    searched = []

    def missing(name):
        searched.append(name)
        raise ImportError(name)

    look_anew()
    monkeypatch.setattr(native.importlib, "import_module", missing)
    try:
        for _ in range(2):
            assert native.empty_for(torch.zeros(2)).shape == (2,)
            assert not strategies_native.available()
    finally:
        look_anew()
    assert searched == ["rasterizers.cpp._baseline", "clear_strategies.kernels._baseline"]


@pytest.mark.parametrize("stated", ["of yesterday", None])
def test_kernels_of_other_sources_are_refused_and_nothing_takes_their_place(stated, monkeypatch):
    """As after `git pull` without a new install, None before modules stated their sources."""
    for package in ("rasterizers.cpp", "clear_strategies.kernels"):
        module = native.load_kernels(package, "baseline")
        if stated is None:
            monkeypatch.delattr(module, "sources")
        else:
            monkeypatch.setattr(module, "sources", stated)
    look_anew()
    for load in (cpp, strategies_native.available, rasterizers.fastest):
        with pytest.raises(OutdatedKernels, match=r"from other sources .* Install again: pip install") as refused:
            load()
        assert exit_codes.describe(refused.value) == (2, str(refused.value))
    look_anew()


def test_an_instruction_set_that_the_processor_lacks_is_refused(monkeypatch):
    with pytest.raises(BackendUnavailable, match="isa=z80 cannot run here"):
        native.load_kernels("rasterizers.cpp", "z80")
    monkeypatch.setenv("CLEAR_ISA", "z80")
    look_anew()
    with pytest.raises(BackendUnavailable, match="CLEAR_ISA=z80"):
        native.load_kernels("rasterizers.cpp")
    monkeypatch.delenv("CLEAR_ISA")
    native.load_kernels("rasterizers.cpp")
