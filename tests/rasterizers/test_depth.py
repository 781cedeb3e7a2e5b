"""Expected depth: values worked out by hand, agreement with float64, and what it shares with the image."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch

import rasterizers
from rasterizers import Splats
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import gradient_of, magnitude, pixels_of, scene, to
from tests.helpers.agreement import require_gradient, require_image, require_same_bits
from tests.helpers.backends import (
    ATTRIBUTES,
    BACKENDS,
    CLEAN,
    Backend,
    backends,
    camera,
    cotangents,
    dense_scene,
    everything,
    exact,
    why_not,
)

GEOMETRY = ("means", "quats", "scales", "opacities", "screen")


def balls(*depths: float, opacity=0.6, scale=0.4) -> Splats:
    """Grey balls straight ahead, one behind the other, all as large in the image."""
    n, z = len(depths), torch.tensor(depths, dtype=torch.float64)
    return Splats(
        means=torch.stack((0 * z, 0 * z, z), 1),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(n, 1),
        scales=(scale * z)[:, None].repeat(1, 3),
        opacities=torch.full((n,), opacity, dtype=torch.float64),
        sh0=torch.zeros(n, 1, 3, dtype=torch.float64),
        shN=torch.zeros(n, 0, 3, dtype=torch.float64),
    )


def off(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found.double() - expected).norm() / expected.norm())


# ---- values ------------------------------------------------------------------------------------------------------


def test_a_ball_has_its_own_depth_wherever_it_is_seen():
    for opacity in (0.9, 0.01):
        rendering = rasterizers.load("torch")(balls(3.0, opacity=opacity), camera(21, 21), depth=True)
        seen = rendering.alpha > 0
        assert torch.allclose(rendering.depth[seen], torch.tensor(3.0, dtype=torch.float64), rtol=1e-12)
        assert not rendering.depth[~seen].any()


def test_depth_is_the_mean_by_blending_weight():
    # Equal ellipses of opacity a: the weights are a and (1 - a) a wherever both are drawn.
    rendering = rasterizers.load("torch", kernel=0.0)(balls(2.0, 5.0, scale=1e3), camera(21, 21), depth=True)
    assert float(rendering.depth[10, 10]) == pytest.approx((2 + 0.4 * 5) / 1.4, rel=1e-5)
    assert float(rendering.alpha[10, 10]) == pytest.approx(1 - 0.4**2, rel=1e-5)


def test_depth_is_along_the_camera_s_axis_not_along_the_ray():
    splats = balls(4.0, scale=0.05)
    aside = replace(splats, means=torch.tensor([[2.0, 0.0, 4.0]], dtype=torch.float64))
    rendering = rasterizers.load("torch")(aside, camera(60, 40), depth=True)
    assert float(rendering.depth.max()) == pytest.approx(4.0, rel=1e-12)


def test_moving_everything_back_moves_the_depth_by_as_much():
    splats, view = scene(50, dtype=torch.float64), camera(40, 30)
    rendering = ReferenceRasterizer()(splats, view, depth=True)
    g = rendering.vjp(torch.cat((torch.zeros(30, 40, 3), torch.ones(30, 40, 1)), -1)[None])
    drawn = float((rendering.alpha > 0).double().sum())
    step = 1e-5
    # Larger by one factor about the camera: the image stays, and every depth grows by that factor.
    grown = replace(splats, means=splats.means * (1 + step), scales=splats.scales * (1 + step))
    assert torch.allclose(ReferenceRasterizer()(grown, view, depth=True).depth, rendering.depth * (1 + step), rtol=1e-6)
    found = float((g.means[0] * splats.means).sum() + (g.scales[0] * splats.scales).sum())
    assert found == pytest.approx(float(rendering.depth.sum()), rel=1e-9)
    assert drawn > 600


# ---- agreement ---------------------------------------------------------------------------------------------------


@backends(dtype=torch.float32)
def test_float32_agrees_with_float64_at_the_same_cut_offs(backend):
    splats, view = dense_scene()
    found, expected = backend()(splats, view, depth=True), exact(splats, view, depth=True)
    scale = magnitude(expected)
    require_image(pixels_of(found) / scale, pixels_of(expected) / scale)


@cache
def dense_gradients(backend: Backend):
    """Found and exact gradients of colour and depth, and of depth alone, without cut-offs that rounding may flip."""
    splats, view = dense_scene()
    v = cotangents(2, 97, 130, channels=4)
    v[1, ..., :3] = 0
    found, expected = backend(**CLEAN)(splats, view, depth=True), exact(splats, view, depth=True, **CLEAN)
    return found.vjp(v), expected.vjp(v.double())


@pytest.mark.parametrize("name", ATTRIBUTES)
@backends(dtype=torch.float32)
def test_gradients_agree_without_cut_offs(backend, name):
    found, expected = dense_gradients(backend)
    require_gradient(name, gradient_of(found, name)[0], gradient_of(expected, name)[0])
    if name in GEOMETRY:
        require_gradient(name, gradient_of(found, name)[1], gradient_of(expected, name)[1])
    else:
        assert not gradient_of(found, name)[1].any()  # depth does not depend on the colour


@backends()
def test_the_highest_precision_agrees_with_the_reference(backend):
    splats, view, v = scene(400), camera(97, 66), cotangents(2, 66, 97, channels=4)
    narrow = backend.widest == torch.float32
    settings = {"background": (0.2, 0.4, 0.6), **(CLEAN if narrow else {})}
    found = backend(**settings)(to(splats, backend.widest), view, depth=True)
    expected = ReferenceRasterizer(**settings)(to(splats, torch.float64), view, depth=True)
    error = (pixels_of(found).double() - pixels_of(expected)).abs() / magnitude(expected)
    assert float(error.max()) < (5e-6 if narrow else 1e-12)
    v[..., 3] *= expected.alpha  # E is not smooth where little is drawn
    ours, theirs = found.vjp(v), expected.vjp(v.double())
    for name in ATTRIBUTES:
        assert off(gradient_of(ours, name), gradient_of(theirs, name)) < (5e-5 if narrow else 1e-10), name


@pytest.mark.parametrize("distance", [1.0, 1e2, 1e4])
@backends(dtype=torch.float32)
def test_the_gradient_of_a_distant_surface_keeps_its_digits(backend, distance):
    # Depths that differ in their fourth digit. The error is that of E, a few units in the last place of a float32.
    z = distance * (1 + 1e-3 * torch.rand(40, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    splats = to(to(balls(*z.tolist(), opacity=0.1), torch.float32), torch.float64)
    view, v = camera(16, 16), torch.zeros(1, 16, 16, 4)
    v[..., 3] = cotangents(1, 16, 16)[..., 0]
    found = backend(**CLEAN)(to(splats, torch.float32), view, depth=True).vjp(v)
    expected = exact(splats, view, depth=True, **CLEAN).vjp(v.double())
    assert off(found.opacities, expected.opacities) < 4e-3
    assert off(found.means[..., 2], expected.means[..., 2]) < 1e-4


@backends(dtype=torch.float32)
def test_the_faintest_pixel_has_a_depth(backend):
    # Where alpha is 1e-6, 1 - T has one digit left in float32.
    splats = to(balls(2.0, 6.0, opacity=1e-6, scale=10.0), torch.float32)
    found, v = backend(**CLEAN)(splats, camera(8, 8), depth=True), torch.zeros(1, 8, 8, 4)
    expected = exact(splats, camera(8, 8), depth=True, **CLEAN)
    assert torch.allclose(found.depth.double(), expected.depth, rtol=1e-5)
    v[..., 3] = 1
    assert off(found.vjp(v).opacities, expected.vjp(v.double()).opacities) < 1e-4


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
    silent = torch.cat((v, torch.zeros_like(v[..., :1])), -1)
    for name in ATTRIBUTES:
        a, b = gradient_of(drawn.vjp(silent), name), gradient_of(without.vjp(v), name)
        assert float((a - b).norm()) <= 2e-6 * float(b.norm()), name


@backends()
def test_each_cotangent_may_have_depth_colour_or_both(backend):
    splats, view = dense_scene(800)
    v = cotangents(3, view.height, view.width, channels=4)
    v[0, ..., 3] = 0
    v[1, ..., :3] = 0
    v[2] = v[0] + v[1]
    g = backend(**CLEAN)(splats, view, depth=True).vjp(v)
    for name in ATTRIBUTES:
        colour, depth, both = gradient_of(g, name)
        assert float((colour + depth - both).norm()) <= 2e-5 * float(both.norm()), name


@backends()
def test_bits_with_depth_do_not_depend_on_the_run(backend):
    splats, view = dense_scene(800)
    v = cotangents(3, view.height, view.width, channels=4)
    expected = everything(backend()(splats, view, depth=True), v)
    for _ in range(3):
        require_same_bits(everything(backend()(splats, view, depth=True), v), expected)


@pytest.mark.skipif(bool(why_not("cpp")), reason=str(why_not("cpp")))
def test_bits_with_depth_do_not_depend_on_threads_or_memory():
    splats, view = scene(2000, bands=3, seed=2), camera(1000, 700)
    splats = replace(splats, scales=splats.scales * 3)
    v = cotangents(2, 700, 1000, channels=4)
    expected = everything(rasterizers.load("cpp", threads=1)(splats, view, depth=True), v)
    for settings in ({"threads": 2}, {"threads": 3, "memory": 4}):
        require_same_bits(everything(rasterizers.load("cpp", **settings)(splats, view, depth=True), v), expected)


@backends()
def test_one_of_two_scales_may_have_depth(backend):
    splats, hr = scene(300), camera(128, 96)
    jobs = [(splats, hr.scaled(1 / 4)), (splats, hr)]
    for asked in ([True, False], [False, True], [True, True]):
        for rendering, job, depth in zip(backend().render_scales(jobs, depth=asked), jobs, asked, strict=True):
            v = cotangents(2, job[1].height, job[1].width, channels=4 if depth else 3)
            alone = backend()(*job, depth=depth)
            assert (rendering.depth is not None) == depth
            *found, _ = everything(rendering, v)
            *expected, _ = everything(alone, v)
            require_same_bits(found, expected)


@pytest.mark.parametrize("n", [0, 1, 15, 17])
@backends()
def test_any_number_of_gaussians_has_a_depth(backend, n):
    splats, view = to(scene(300, bands=0), backend.widest), camera(40, 30)
    some = Splats(*(getattr(splats, a)[:n] for a in ("means", "quats", "scales", "opacities", "sh0", "shN")))
    found = backend(**CLEAN)(some, view, depth=True)
    expected = ReferenceRasterizer(**CLEAN)(to(some, torch.float64), view, depth=True)
    error = (pixels_of(found).double() - pixels_of(expected)).abs() / magnitude(expected)
    assert float(error.max()) < 5e-6


# ---- refusals ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["torch", *BACKENDS])
def test_a_cotangent_of_a_depth_that_was_not_drawn_is_refused(name):
    if name in BACKENDS and why_not(name):
        pytest.skip(str(why_not(name)))
    rasterizer = BACKENDS[name]() if name in BACKENDS else rasterizers.load(name)
    rendering = rasterizer(scene(10), camera(20, 10))
    with pytest.raises(ValueError, match=r"must be \[K, 10, 20, 3\], got .* draw with depth=True"):
        rendering.vjp(torch.zeros(1, 10, 20, 4))
    drawn = rasterizer(scene(10), camera(20, 10), depth=True)
    with pytest.raises(ValueError, match=r"must be \[K, 10, 20, 3 or 4\], got \(1, 10, 20, 5\)"):
        drawn.vjp(torch.zeros(1, 10, 20, 5))
