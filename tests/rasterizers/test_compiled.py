"""The compiled backends: the public checks, agreement with float64, reproducible bits, hard inputs, expected depth."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

import rasterizers
from rasterizers import Camera, Splats
from rasterizers.geometry import SH_C0
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import CHECKS, gradient_of, magnitude, pixels_of, scene, select
from tests.helpers.backends import (
    ATTRIBUTES,
    CLEAN,
    EVERY,
    backends,
    balls,
    camera,
    cotangents,
    dense_scene,
    everything,
    exact,
    needs,
    require_gradient,
    require_image,
    require_same_bits,
)

WITH_REFERENCE = pytest.mark.parametrize(
    "backend", [pytest.param(make, id=name, marks=needs(name)) for name, make in EVERY.items()]
)
WITH_DEPTH = pytest.mark.parametrize("depth", [False, True], ids=["image", "depth"])


def require_reference(backend, splats, view, v, *, depth=False, **settings):
    """A backend agrees with the reference at its highest precision; in float32 without cut-offs, which rounding may flip."""
    narrow = backend.widest == torch.float32
    settings = {**settings, **(CLEAN if narrow else {})}
    of_image, of_gradient = (5e-6, 5e-5) if narrow else (1e-12, 1e-10)
    found = backend(**settings)(splats.to(backend.widest), view, depth=depth)
    expected = ReferenceRasterizer(**settings)(splats.to(torch.float64), view, depth=depth)
    error = (pixels_of(found).double() - pixels_of(expected)).abs() / magnitude(expected)
    assert float(error.max()) < of_image
    assert float((found.alpha.double() - expected.alpha).abs().max()) < of_image
    ours, theirs = found.vjp(v), expected.vjp(v.double())
    for name in ATTRIBUTES:
        a, b = gradient_of(ours, name), gradient_of(theirs, name)
        assert a.shape == b.shape
        assert float((a - b).norm()) <= of_gradient * float(b.norm()) + 1e-14, name
    return found, expected


@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
@WITH_REFERENCE
def test_every_backend_passes_the_checks(backend, check):
    """The reference, too, and each instruction set."""
    check(backend)


# ---- agreement ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("settings", [{}, CLEAN], ids=["default", "clean"])
@pytest.mark.parametrize(("bands", "depth"), [(0, False), (15, False), (3, True)])
@backends()
def test_the_highest_precision_agrees_with_the_reference(backend, settings, bands, depth):
    settings = {**settings, "background": (0.2, 0.4, 0.6)}
    require_reference(backend, scene(400, bands=bands), camera(97, 66), cotangents(2, 66, 97), depth=depth, **settings)


@WITH_DEPTH
@backends(dtype=torch.float32)
def test_float32_agrees_with_float64_at_the_same_cut_offs(backend, depth):
    splats, view = dense_scene()
    found, expected = backend()(splats, view, depth=depth), exact(splats, view, depth=depth)
    require_image(pixels_of(found) / magnitude(expected), pixels_of(expected) / magnitude(expected))


@backends(dtype=torch.float32)
def test_gradients_agree_without_cut_offs(backend):
    splats, view = dense_scene()
    v = cotangents(1, 97, 130)
    found, expected = backend(**CLEAN)(splats, view).vjp(v), exact(splats, view, **CLEAN).vjp(v.double())
    for name in ATTRIBUTES:
        require_gradient(name, gradient_of(found, name)[0], gradient_of(expected, name)[0])


@pytest.mark.parametrize("length", [1e2, 1e3, 1e4])
@backends(dtype=torch.float32)
def test_gradients_of_needles_agree_with_float64(backend, length):
    """Σ'⁻¹ T of a needle `length` px long and 0.3 px wide is small, and Σ'⁻¹ is not: the product of both cancels."""
    splats, view, v = scene(30), camera(), cotangents(1, 47, 65)
    splats = replace(splats, scales=splats.means[:, 2:] / view.fx * torch.tensor([[length, 0.3, 0.3]]))
    found, expected = backend()(splats, view).vjp(v), exact(splats, view).vjp(v.double())
    for name in ATTRIBUTES:
        a, b = gradient_of(found, name), gradient_of(expected, name)
        assert float((a - b).norm()) <= 5e-5 * float(b.norm()), name


@pytest.mark.parametrize("limit", [1e-9, 0.0])
@backends(dtype=torch.float32)
def test_transmittance_survives_four_hundred_layers(backend, limit):
    n = 400
    # Near α = 1, an error of α is 1/(1 - α) times as large in T.
    for alpha, tolerance in ((1 / 200, 1e-5), (0.05, 1e-5), (0.5, 1e-5), (0.98, 1e-4)):
        splats = replace(
            balls(*(2 + 1e-3 * i for i in range(n)), opacity=alpha, dtype=torch.float32),
            scales=torch.full((n, 3), 2.0),
            sh0=torch.randn(n, 1, 3, generator=torch.Generator().manual_seed(5)),  # equal colours would cancel
        )
        view, v = camera(8, 8), cotangents(1, 8, 8)
        settings = {"alpha_min": 1e-6, "transmittance_min": limit}
        found, right = backend(**settings)(splats, view), exact(splats, view, **settings)
        assert float((found.image.double() - right.image).abs().max()) < 5e-6
        ours, expected = found.vjp(v), right.vjp(v.double())
        for name in ("opacities", "sh0"):
            a, b = gradient_of(ours, name).double(), gradient_of(expected, name)
            assert float((a - b).norm() / b.norm()) < tolerance


@cache
def needle(aspect, pixels, turned):
    """A Gaussian turned about z by this angle, its image and its gradients in float64."""
    view, size = camera(64, 64), pixels * 4.0 / camera(64, 64).fx
    splats = replace(
        balls(4.0, opacity=0.4, dtype=torch.float32),
        means=torch.tensor([[0.05, -0.02, 4.0]]),
        quats=torch.tensor([[math.cos(turned / 2), 0, 0, math.sin(turned / 2)]]),
        scales=torch.tensor([[size, size / aspect, size / aspect]]),
    )
    right = ReferenceRasterizer(**CLEAN)(splats.to(torch.float64), view)
    return splats, right.image, right.vjp(cotangents(1, 64, 64).double())


@pytest.mark.parametrize("aspect", [1.0, 1e2, 1e4])
@pytest.mark.parametrize("pixels", [1e-2, 1.0, 1e3, 1e5])
@backends(dtype=torch.float32)
def test_needles_keep_their_shape(backend, aspect, pixels):
    for i in range(0, 24, 5):
        splats, image, expected = needle(aspect, pixels, i * math.pi / 24)
        found = backend(**CLEAN)(splats, camera(64, 64))
        assert float((found.image.double() - image).abs().max()) < 2e-6
        ours = found.vjp(cotangents(1, 64, 64))
        for name in ("means", "scales", "opacities"):
            a, b = gradient_of(ours, name).double(), gradient_of(expected, name)
            assert bool(a.isfinite().all())
            assert float((a - b).norm()) <= 2e-4 * float(b.norm()) + 1e-8, (name, i)


@pytest.mark.parametrize("turned", [0.5, 1.2, 2.5])
@WITH_REFERENCE
def test_far_along_a_needle_nothing_cancels(backend, turned):
    """The image shows what lies 600 px from the centre of a needle 0.3 px wide. The terms of its conic are near 10^6 there."""
    view, v = camera(64, 64), cotangents(1, 64, 64)
    pixel = 4.0 / view.fx
    away = torch.tensor([[600 * math.cos(turned) + 0.7, 600 * math.sin(turned) + 0.9, 0.0]]) * pixel
    splats = replace(
        needle(1e3, 400.0, turned)[0], means=torch.tensor([[0.0, 0.0, 4.0]]) + away,
        scales=torch.tensor([[400.0, 1e-3, 1e-3]]) * pixel,
    )  # fmt: skip
    settings = {**CLEAN, "antialiased": False}
    found, right = backend(**settings)(splats, view), exact(splats, view, **settings)
    assert float(right.alpha.max()) > 0.1
    assert float((found.image.double() - right.image).abs().max()) < 2e-5
    ours, expected = found.vjp(v), right.vjp(v.double())
    for attribute in ("means", "quats", "scales", "opacities", "screen"):
        a, b = gradient_of(ours, attribute).double(), gradient_of(expected, attribute)
        assert float((a - b).norm()) <= 1e-3 * float(b.norm()), attribute


# ---- the same bits -----------------------------------------------------------------------------------------------
@WITH_DEPTH
@backends()
def test_bits_do_not_depend_on_the_run(backend, depth):
    splats, view = dense_scene()
    v = cotangents(3, 97, 130)
    expected = everything(backend()(splats, view, depth=depth), v)
    for _ in range(3):
        require_same_bits(everything(backend()(splats, view, depth=depth), v), expected)


@backends()
def test_lists_beyond_the_memory_budget_are_refused(backend):
    splats = scene(16_000, bands=0)  # each covers the whole image: what one bin needs is more than 1 MiB
    huge = replace(splats, scales=splats.scales * 1e3)
    with pytest.raises(MemoryError, match=r"Gaussian.* MiB.*largest Gaussian is number \d+"):
        backend(memory=1)(huge, camera(2000, 64))
    with pytest.raises(ValueError, match="at least 1 MiB"):
        backend(memory=0)


SCALES = [(2, (1, 0)), (3, (0, 0)), (4, (0, 1)), (4, (0, 0)), (7, (1, 1)), (8, (1, 1))]  # 1/3 and 1/7 are rounded


@pytest.mark.parametrize(("factor", "depths"), SCALES, ids=str)
@backends()
def test_scales_drawn_together_equal_scales_drawn_alone(backend, depths, factor):
    splats, hr = scene(500, bands=15), camera(32 * factor, 24 * factor)
    plain = replace(splats, rgb_offset=None, opacities=splats.opacities * 0.9)
    jobs = [(plain, hr.scaled(1 / factor)), (splats, hr)]
    depths = list(map(bool, depths))
    for rendering, job, depth in zip(backend().render_scales(jobs, depth=depths), jobs, depths, strict=True):
        assert (rendering.depth is not None) == depth
        v = cotangents(2, job[1].height, job[1].width)
        *found, _ = everything(rendering, v)  # Y is not 0 for a Gaussian that is visible at the other scale only
        *expected, _ = everything(backend()(*job, depth=depth), v)
        require_same_bits(found, expected)


@backends()
def test_jobs_that_share_nothing_are_drawn_alone_and_images_stay_valid_while_later_ones_are_drawn(backend):
    a, b, view = scene(50, seed=1), scene(50, seed=2), camera()
    for rendering, job in zip(backend().render_scales([(a, view), (b, view)]), (a, b), strict=True):
        assert torch.equal(rendering.image, backend()(job, view).image)
    splats, view = scene(3000), camera(200, 150)
    kept = backend()(splats, view).image
    before = kept.clone()
    for _ in range(5):
        backend()(splats, view).vjp(cotangents(1, 150, 200))
    assert torch.equal(kept, before)


@backends()
def test_equal_depths_are_ordered_by_index_and_long_lists_are_blended_to_the_end(backend):
    # With all Gaussians at one depth, the image follows the order of their indices.
    splats, view = scene(64), camera(32, 32)
    flat = replace(splats, means=torch.cat((splats.means[:, :2], torch.full((64, 1), 5.0)), dim=1))
    require_image(backend()(flat, view).image, ReferenceRasterizer()(flat.to(torch.float64), view).image)
    reverse = torch.arange(63, -1, -1)
    assert not torch.equal(backend()(select(flat, reverse), view).image, backend()(flat, view).image)
    # More Gaussians over a tile than a buffer holds (cpp: 2048), most of them faint, so that no pixel ends early.
    splats, view = scene(5000, bands=0, seed=3), camera(33, 31)
    faint = replace(splats, opacities=splats.opacities * 0.02)
    require_reference(backend, faint, view, cotangents(2, 31, 33))


# ---- shapes and borders ------------------------------------------------------------------------------------------
@pytest.mark.parametrize("n", [0, 1, 2, 15, 16, 17, 255, 257])
@backends()
def test_any_number_of_gaussians(backend, n):
    splats, view = select(scene(300), torch.arange(n)), camera(40, 30)
    require_reference(backend, splats, view, cotangents(1, 30, 40), depth=True)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (15, 16), (16, 17), (31, 33), (32, 32), (64, 65)])
@backends()
def test_any_image_size(backend, size):
    found, expected = require_reference(backend, scene(80), camera(*size), cotangents(1, size[1], size[0]))
    assert torch.equal(found.visible, expected.visible)


LAYOUTS = {
    "transposed": lambda x: x.movedim(0, -1).contiguous().movedim(-1, 0),
    "rows apart": lambda x: torch.stack((x, x), 1)[:, 0],  # as a view of the active bands
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@backends()
def test_tensors_of_any_layout_are_drawn_like_copies(backend, layout):
    splats, view = scene(60, bands=15), camera()
    v = cotangents(1, view.height, view.width)
    expected = everything(backend()(splats, view), v)
    for name in (name for name in ATTRIBUTES if name != "screen"):
        other = replace(splats, **{name: layout(getattr(splats, name))})
        require_same_bits(everything(backend()(other, view), v), expected)


@backends()
def test_a_black_gaussian_gets_the_gradient_of_its_colour(backend):
    """A colour of exactly 0 may come out below it by rounding."""
    black = Splats(
        means=torch.tensor([[0.0, 0, 4]]), quats=torch.tensor([[1.0, 0, 0, 0]]), scales=torch.full((1, 3), 0.3),
        opacities=torch.tensor([0.5]), sh0=torch.tensor([[[-0.5 / SH_C0, -0.5 / SH_C0, 0.0]]]), shN=torch.zeros(1, 0, 3),
    )  # fmt: skip
    view = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
    gradient = backend()(black, view).vjp(torch.ones(1, 16, 16, 3)).sh0[0, 0, 0]
    assert torch.allclose(gradient[:2], gradient[2:].expand(2), rtol=1e-5)
    assert float(gradient[2]) > 0


# ---- values ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("opacity", "x"), [(0.9, 0.0), (0.01, 0.0), (0.6, 2.0)])
def test_a_ball_has_its_depth_along_the_camera_s_axis_wherever_it_is_seen(opacity, x):
    ball = replace(balls(3.0, opacity=opacity), means=torch.tensor([[x, 0.0, 3.0]], dtype=torch.float64))
    rendering = rasterizers.load("torch")(ball, camera(21, 21), depth=True)
    seen = rendering.alpha > 0
    assert seen.any()
    assert torch.allclose(rendering.depth[seen], torch.tensor(3.0, dtype=torch.float64), rtol=1e-12)
    assert not rendering.depth[~seen].any()


def test_depth_is_the_mean_by_blending_weight():
    # Equal ellipses of opacity a: the weights are a and (1 - a) a wherever both are drawn.
    rendering = rasterizers.load("torch", kernel=0.0)(balls(2.0, 5.0, scale=1e3), camera(21, 21), depth=True)
    assert float(rendering.depth[10, 10]) == pytest.approx((2 + 0.4 * 5) / 1.4, rel=1e-5)
    assert float(rendering.alpha[10, 10]) == pytest.approx(1 - 0.4**2, rel=1e-5)


# ---- agreement ---------------------------------------------------------------------------------------------------
@backends(dtype=torch.float32)
def test_the_faintest_pixel_has_a_depth(backend):
    # Where alpha is 1e-6, 1 - T has one digit left in float32.
    splats = balls(2.0, 6.0, opacity=1e-6, scale=10.0).to(torch.float32)
    found = backend(**CLEAN)(splats, camera(8, 8), depth=True)
    expected = exact(splats, camera(8, 8), depth=True, **CLEAN)
    assert torch.allclose(found.depth.double(), expected.depth, rtol=1e-5)


# ---- beside the image --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("k", [1, 2, 3, 4])
@backends()
def test_depth_does_not_change_the_image_or_its_gradients(backend, k):
    splats, view = dense_scene(800)
    v = cotangents(k, view.height, view.width)
    without, drawn = backend()(splats, view), backend()(splats, view, depth=True)
    assert without.depth is None
    assert torch.equal(drawn.image, without.image)
    require_same_bits(everything(drawn, v)[1:], everything(without, v)[1:])
