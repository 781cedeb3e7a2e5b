"""The compiled backend: the public contract, agreement with float64, the same bits however it is run, hard inputs."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from itertools import product

import pytest
import torch
from rasterizers_agreement import require_gradient, require_image, require_same_bits

import rasterizers
from rasterizers import BackendUnavailable, Camera, Splats, native
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import CHECKS, gradient_of, scene, select, to

WHY_NOT = rasterizers.available()["cpp"]
pytestmark = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))

ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN", "rgb_offset", "screen")
CLEAN = {"alpha_min": 1e-7, "transmittance_min": 1e-9}  # cut-offs far below what float32 resolves: no flips


def cpp(**settings):
    return rasterizers.load("cpp", **settings)


def camera(width=65, height=47) -> Camera:
    return Camera(torch.eye(4), 0.9 * width, 0.9 * width, 0.52 * width, 0.47 * height, width, height)


def cotangents(k, height, width, seed=0) -> torch.Tensor:
    return torch.randn(k, height, width, 3, generator=torch.Generator().manual_seed(seed))


def everything(rendering, v):
    g = rendering.vjp(v)
    picture = (rendering.image, rendering.alpha, rendering.means2d, rendering.visible)
    return (*picture, *(gradient_of(g, name) for name in ATTRIBUTES), g.basis)


@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
def test_contract(check):
    check(cpp)


@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_every_instruction_set_keeps_the_contract(isa):
    try:
        runs_here = [*native.load_kernels("rasterizers.cpp").instruction_sets(), "baseline"]
    except BackendUnavailable as reason:
        pytest.skip(str(reason))
    if isa not in runs_here:
        pytest.skip(f"this processor has no {isa}")
    program = (
        "import torch; torch.set_num_threads(1)\n"
        "from rasterizers.testing import check_rasterizer; from rasterizers.cpp import create\n"
        "check_rasterizer(create)\n"
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


def test_auto_takes_the_compiled_backend():
    assert rasterizers.fastest() == "cpp"


# ---- agreement ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, CLEAN], ids=["default", "clean"])
@pytest.mark.parametrize("bands", [0, 15])
def test_float64_is_the_reference(settings, bands):
    splats, view = scene(400, bands=bands, dtype=torch.float64), camera(97, 66)
    settings = {**settings, "background": (0.2, 0.4, 0.6)}
    found, exact = cpp(**settings)(splats, view), ReferenceRasterizer(**settings)(splats, view)
    assert float((found.image - exact.image).abs().max()) < 1e-12
    assert float((found.alpha - exact.alpha).abs().max()) < 1e-12
    v = cotangents(2, 66, 97).double()
    ours, truth = found.vjp(v), exact.vjp(v)
    for name in ATTRIBUTES:
        b = gradient_of(truth, name)
        if b.numel():
            error = float(torch.linalg.vector_norm(gradient_of(ours, name) - b) / torch.linalg.vector_norm(b))
            assert error < 1e-11, name


def dense_scene(n=3000):
    """Deep enough that pixels end: some hundred Gaussians over each."""
    splats = scene(n, bands=15, seed=4)
    return replace(splats, scales=splats.scales * 0.35), camera(130, 97)


def test_float32_agrees_with_float64_at_the_same_cut_offs():
    splats, view = dense_scene()
    require_image(cpp()(splats, view).image, cpp()(to(splats, torch.float64), view).image)


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_gradients_agree_where_no_threshold_flips(name):
    splats, view = dense_scene()
    v = cotangents(1, 97, 130)
    found, exact = cpp(**CLEAN)(splats, view).vjp(v), cpp(**CLEAN)(to(splats, torch.float64), view).vjp(v.double())
    require_gradient(name, gradient_of(found, name)[0], gradient_of(exact, name)[0])


def test_transmittance_survives_four_hundred_layers():
    n = 400
    # Near α = 1 the last digit of α itself is worth 1/(1 - α) of them in T.
    for alpha, tolerance in ((1 / 200, 1e-5), (0.05, 1e-5), (0.5, 1e-5), (0.98, 1e-4)):
        splats = Splats(
            means=torch.tensor([[0.0, 0.0, 2.0]]).repeat(n, 1) + torch.arange(n)[:, None] * torch.tensor([0, 0, 1e-3]),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
            scales=torch.full((n, 3), 2.0),
            opacities=torch.full((n,), alpha),
            sh0=torch.randn(n, 1, 3, generator=torch.Generator().manual_seed(5)),  # equal colours would cancel
            shN=torch.zeros(n, 0, 3),
        )
        view, v = camera(8, 8), cotangents(1, 8, 8)
        settings = {"alpha_min": 1e-6, "transmittance_min": 1e-9}
        found, exact = cpp(**settings)(splats, view), cpp(**settings)(to(splats, torch.float64), view)
        assert float((found.image.double() - exact.image).abs().max()) < 5e-6
        ours, truth = found.vjp(v), exact.vjp(v.double())
        for name in ("opacities", "sh0"):
            a, b = gradient_of(ours, name).double(), gradient_of(truth, name)
            assert float((a - b).norm() / b.norm()) < tolerance


@pytest.mark.parametrize("aspect", [1.0, 1e2, 1e4])
@pytest.mark.parametrize("pixels", [1e-2, 1.0, 1e3, 1e5])
def test_needles_keep_their_shape(aspect, pixels):
    n, view = 24, camera(64, 64)
    angle = torch.arange(n) * math.pi / n
    size = pixels * 4.0 / view.fx
    splats = Splats(
        means=torch.tensor([[0.05, -0.02, 4.0]]).repeat(n, 1),
        quats=torch.stack((torch.cos(angle / 2), 0 * angle, 0 * angle, torch.sin(angle / 2)), dim=1),
        scales=torch.tensor([[size, size / aspect, size / aspect]]).repeat(n, 1),
        opacities=torch.full((n,), 0.4),
        sh0=torch.full((n, 1, 3), 0.5),
        shN=torch.zeros(n, 0, 3),
    )
    v = cotangents(1, 64, 64)
    for i in range(0, n, 5):
        one = select(splats, torch.tensor([i]))
        found, exact = cpp(**CLEAN)(one, view), ReferenceRasterizer(**CLEAN)(to(one, torch.float64), view)
        assert float((found.image.double() - exact.image).abs().max()) < 5e-5
        ours, truth = found.vjp(v), exact.vjp(v.double())
        for name in ("means", "scales", "opacities"):
            a, b = gradient_of(ours, name).double(), gradient_of(truth, name)
            assert bool(a.isfinite().all())
            assert float((a - b).norm()) <= 2e-3 * float(b.norm()) + 1e-6, (name, i)


def sweep(seed=0, cases=400):
    """Sizes, depths, opacities and quaternion norms over many orders of magnitude: a sample of their product."""
    scales, depths = [10.0**k for k in range(-8, 9)], [10.0**k for k in range(-6, 7)]
    logits, norms = (-100.0, -15.0, -3.0, 0.0, 3.0, 15.0, 100.0), [10.0**k for k in range(-20, 21, 5)]
    table = list(product(scales, depths, logits, norms))
    chosen = torch.randperm(len(table), generator=torch.Generator().manual_seed(seed))[:cases]
    return [table[int(i)] for i in chosen]


def test_extreme_gaussians_are_right_or_absent():
    # Finite and as in float64, or culled as the near plane and alpha_min say.
    view, settings = camera(24, 20), {"near": 1e-4, "background": (0.1, 0.2, 0.3)}
    v, drawn = cotangents(1, 20, 24), 0
    for scale, depth, logit, norm in sweep():
        splats = Splats(
            means=torch.tensor([[0.03 * depth, -0.02 * depth, depth]]),
            quats=torch.tensor([[0.5, -0.5, 0.1, 0.7]]) * norm,
            scales=torch.tensor([[scale, scale * 0.5, scale * 0.1]]),
            opacities=torch.sigmoid(torch.tensor([logit])),
            sh0=torch.tensor([[[0.5, -0.2, 0.9]]]),
            shN=torch.zeros(1, 0, 3),
        )
        found = cpp(**settings)(splats, view)
        exact = cpp(**settings)(to(splats, torch.float64), view)
        case = f"scale {scale:g} depth {depth:g} logit {logit:g} norm {norm:g}"
        error = float((found.image.double() - exact.image).abs().max())
        assert error < 1e-4 or (error < FLIP_OF_ONE and bool(found.visible) == bool(exact.visible)), (case, error)
        assert all(bool(gradient_of(found.vjp(v), name).isfinite().all()) for name in ATTRIBUTES), case
        drawn += bool(exact.visible)
    assert drawn > 50


FLIP_OF_ONE = 1 / 255 + 1e-3  # a single Gaussian at alpha_min: drawn by one precision, passed over by the other


# ---- the same bits -----------------------------------------------------------------------------------------------


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
    assert bands._frame.native.pairs(0) * 16 > 4 << 20  # it does take bands
    require_same_bits(everything(bands, v), one_band)


def test_more_than_the_budget_is_refused_with_figures():
    splats = scene(4000, bands=0)
    huge = replace(splats, scales=splats.scales * 1e3)
    with pytest.raises(MemoryError, match=r"pairs of Gaussian and bin.*MiB.*largest Gaussian is number \d+"):
        cpp(memory=1)(huge, camera(2000, 64))


def test_scales_together_are_scales_alone():
    splats, hr = scene(500, bands=15), camera(128, 96)
    lr = hr.scaled(1 / 4)
    plain = replace(splats, rgb_offset=None, opacities=splats.opacities * 0.9)
    shared = cpp().render_scales([(plain, lr), (splats, hr)])
    for rendering, (job, view) in zip(shared, [(plain, lr), (splats, hr)], strict=True):
        v = cotangents(2, view.height, view.width)
        alone = cpp()(job, view)
        *found, _ = everything(rendering, v)  # Y is of the union: not 0 for a Gaussian that only the other screen shows
        *expected, _ = everything(alone, v)
        require_same_bits(found, expected)


def test_scales_that_share_nothing_are_drawn_alone():
    a, b, view = scene(50, seed=1), scene(50, seed=2), camera()
    for rendering, job in zip(cpp().render_scales([(a, view), (b, view)]), (a, b), strict=True):
        assert torch.equal(rendering.image, cpp()(job, view).image)


def test_order_is_by_depth_then_index_in_every_storage():
    # Gaussians of one depth but different index: the picture follows the index, whoever else is there.
    splats, view = scene(64), camera(32, 32)
    flat = replace(splats, means=torch.cat((splats.means[:, :2], torch.full((64, 1), 5.0)), dim=1))
    exact = ReferenceRasterizer()(to(flat, torch.float64), view).image
    require_image(cpp()(flat, view).image, exact)
    reverse = torch.arange(63, -1, -1)
    assert not torch.equal(cpp()(select(flat, reverse), view).image, cpp()(flat, view).image)


def test_long_bins_are_worked_off_in_segments():
    # More Gaussians over one bin than a segment holds (2048), most of them faint: every pixel sees the whole list.
    splats, view = scene(5000, bands=0, seed=3), camera(33, 31)
    faint = replace(splats, opacities=splats.opacities * 0.02)
    v = cotangents(2, 31, 33).double()
    wide = to(faint, torch.float64)
    found, exact = cpp()(wide, view), ReferenceRasterizer()(wide, view)
    assert float((found.image - exact.image).abs().max()) < 1e-11
    ours, truth = found.vjp(v), exact.vjp(v)
    for name in ("means", "opacities", "rgb_offset"):
        b = gradient_of(truth, name)
        assert float((gradient_of(ours, name) - b).norm() / b.norm()) < 1e-10


# ---- shapes and borders ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 2, 15, 16, 17, 255, 257])
def test_any_number_of_gaussians(n):
    splats, view = scene(300, dtype=torch.float64), camera(40, 30)
    some = select(splats, torch.arange(n))
    v = cotangents(1, 30, 40).double()
    found, exact = cpp()(some, view), ReferenceRasterizer()(some, view)
    assert float((found.image - exact.image).abs().max()) < 1e-12
    for name in ATTRIBUTES:
        a, b = gradient_of(found.vjp(v), name), gradient_of(exact.vjp(v), name)
        assert a.shape == b.shape
        assert float((a - b).norm()) <= 1e-10 * float(b.norm()) + 1e-14


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (15, 16), (16, 17), (31, 33), (32, 32), (64, 65)])
def test_any_image_size(size):
    splats, view = scene(80, dtype=torch.float64), camera(*size)
    found, exact = cpp()(splats, view), ReferenceRasterizer()(splats, view)
    assert float((found.image - exact.image).abs().max()) < 1e-12
    assert torch.equal(found.visible, exact.visible)


@pytest.mark.parametrize("tile", [4, 8, 16, 32, 64])
def test_tiles_not_asked_for_cost_nothing_and_change_nothing(tile):
    splats, view = scene(200), camera(100, 70)
    rasterizer = cpp(tile=tile)
    rows, columns = -(-70 // tile), -(-100 // tile)
    mask = torch.rand(rows, columns, generator=torch.Generator().manual_seed(1)) < 0.4
    pixels = mask.repeat_interleave(tile, 0).repeat_interleave(tile, 1)[:70, :100]
    full, part = rasterizer(splats, view), rasterizer(splats, view, tiles=mask)
    assert torch.equal(part.image[pixels], full.image[pixels])
    assert not part.image[~pixels].any()
    v = cotangents(1, 70, 100)
    a, b = part.vjp(v), full.vjp(v * pixels[None, :, :, None])
    for name in ATTRIBUTES:
        expected = gradient_of(b, name)
        assert float((gradient_of(a, name) - expected).norm()) <= 2e-6 * float(expected.norm())
    assert torch.equal(part.visible, full.visible)


def test_inactive_bands_are_stepped_over():
    splats, view = scene(60, bands=15), camera()
    active = replace(splats, shN=splats.shN[:, :3])  # a view: rows lie 45 numbers apart
    assert not active.shN.is_contiguous()
    packed = replace(splats, shN=splats.shN[:, :3].contiguous())
    v = cotangents(1, view.height, view.width)
    require_same_bits(everything(cpp()(active, view), v), everything(cpp()(packed, view), v))


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh0", "shN", "rgb_offset"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_named(name, bad):
    splats = scene(20)
    visible = int(cpp()(splats, camera()).visible.nonzero()[3])
    value = getattr(splats, name).clone()
    value[visible].view(-1)[-1] = bad
    with pytest.raises(ValueError, match=f"splats.{name} must be finite; Gaussian {visible}"):
        cpp()(replace(splats, **{name: value}), camera())


def test_half_precision_is_refused():
    with pytest.raises(TypeError, match="float32 and float64"):
        cpp()(to(scene(3), torch.float16), camera())


@pytest.mark.parametrize(
    ("setting", "rule"),
    [({"tile": 6}, "multiple of 4"), ({"memory": 0}, "at least 1 MiB"), ({"threads": 0}, "at least 1")],
)
def test_settings_out_of_range_are_named(setting, rule):
    with pytest.raises(ValueError, match=rule):
        cpp(**setting)


def test_a_picture_outlives_its_rasterizer_and_its_memory_is_used_again():
    splats, view = scene(3000), camera(200, 150)
    kept = cpp()(splats, view).image
    before = kept.clone()
    for _ in range(5):
        cpp()(splats, view).vjp(cotangents(1, 150, 200))
    assert torch.equal(kept, before)
