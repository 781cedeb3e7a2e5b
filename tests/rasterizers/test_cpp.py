"""The backend "cpp" alone: its instruction sets, its threads and its memory budget."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import pytest

import rasterizers
from rasterizers import BackendUnavailable, native
from rasterizers.testing import scene
from tests.helpers.agreement import require_same_bits
from tests.helpers.backends import camera, cotangents, dense_scene, everything, why_not

pytestmark = pytest.mark.skipif(bool(why_not("cpp")), reason=str(why_not("cpp")))


def cpp(**settings):
    return rasterizers.load("cpp", **settings)


@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_every_instruction_set_passes_the_checks(isa):
    try:
        runs_here = [*native.load_kernels("rasterizers.cpp").instruction_sets(), "baseline"]
    except BackendUnavailable as reason:
        pytest.skip(str(reason))
    if isa not in runs_here:
        pytest.skip(f"this processor has no {isa}")
    program = (
        "import torch; torch.set_num_threads(1)\n"
        "from rasterizers.testing import check_rasterizer; from rasterizers.cpp import CppRasterizer\n"
        "check_rasterizer(CppRasterizer)\n"
        "from rasterizers.native import load_kernels; print(load_kernels('rasterizers.cpp').isa)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "CLEAR_ISA": isa},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == isa


def test_bits_do_not_depend_on_threads():
    splats, view = dense_scene()
    v = cotangents(3, 97, 130)
    expected = everything(cpp(threads=1)(splats, view), v)
    for threads in (2, 3, 4, 8):
        for _ in range(2):
            require_same_bits(everything(cpp(threads=threads)(splats, view), v), expected)


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
