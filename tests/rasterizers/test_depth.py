"""Expected depth: values worked out by hand, agreement with float64, and what it shares with the image."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import rasterizers
from rasterizers import Splats
from rasterizers.checks import require_cotangents
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import magnitude, pixels_of, scene, to
from tests.helpers.agreement import require_image, require_same_bits
from tests.helpers.backends import (
    CLEAN,
    backends,
    camera,
    cotangents,
    dense_scene,
    everything,
    exact,
    why_not,
)


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
    step = 1e-5
    # Larger by one factor about the camera: the image stays, and every depth grows by that factor.
    grown = replace(splats, means=splats.means * (1 + step), scales=splats.scales * (1 + step))
    assert torch.allclose(ReferenceRasterizer()(grown, view, depth=True).depth, rendering.depth * (1 + step), rtol=1e-6)
    assert int((rendering.alpha > 0).sum()) > 600


# ---- agreement ---------------------------------------------------------------------------------------------------


@backends(dtype=torch.float32)
def test_float32_agrees_with_float64_at_the_same_cut_offs(backend):
    splats, view = dense_scene()
    found, expected = backend()(splats, view, depth=True), exact(splats, view, depth=True)
    scale = magnitude(expected)
    require_image(pixels_of(found) / scale, pixels_of(expected) / scale)


@backends()
def test_the_highest_precision_agrees_with_the_reference(backend):
    splats, view = scene(400), camera(97, 66)
    narrow = backend.widest == torch.float32
    settings = {"background": (0.2, 0.4, 0.6), **(CLEAN if narrow else {})}
    found = backend(**settings)(to(splats, backend.widest), view, depth=True)
    expected = ReferenceRasterizer(**settings)(to(splats, torch.float64), view, depth=True)
    error = (pixels_of(found).double() - pixels_of(expected)).abs() / magnitude(expected)
    assert float(error.max()) < (5e-6 if narrow else 1e-12)


@backends(dtype=torch.float32)
def test_the_faintest_pixel_has_a_depth(backend):
    # Where alpha is 1e-6, 1 - T has one digit left in float32.
    splats = to(balls(2.0, 6.0, opacity=1e-6, scale=10.0), torch.float32)
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


@backends()
def test_bits_with_depth_do_not_depend_on_the_run(backend):
    splats, view = dense_scene(800)
    v = cotangents(3, view.height, view.width)
    expected = everything(backend()(splats, view, depth=True), v)
    for _ in range(3):
        require_same_bits(everything(backend()(splats, view, depth=True), v), expected)


@pytest.mark.skipif(bool(why_not("cpp")), reason=str(why_not("cpp")))
def test_bits_with_depth_do_not_depend_on_threads_or_memory():
    splats, view = scene(2000, bands=3, seed=2), camera(1000, 700)
    splats = replace(splats, scales=splats.scales * 3)
    v = cotangents(2, 700, 1000)
    expected = everything(rasterizers.load("cpp", threads=1)(splats, view, depth=True), v)
    for settings in ({"threads": 2}, {"threads": 3, "memory": 4}):
        require_same_bits(everything(rasterizers.load("cpp", **settings)(splats, view, depth=True), v), expected)


@backends()
def test_one_of_two_scales_may_have_depth(backend):
    splats, hr = scene(300), camera(128, 96)
    jobs = [(splats, hr.scaled(1 / 4)), (splats, hr)]
    for asked in ([True, False], [False, True], [True, True]):
        for rendering, job, depth in zip(backend().render_scales(jobs, depth=asked), jobs, asked, strict=True):
            v = cotangents(2, job[1].height, job[1].width)
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


def test_depth_has_no_cotangent():
    with pytest.raises(ValueError, match=r"must be \[K, 10, 20, 3\], got \(1, 10, 20, 4\)"):
        require_cotangents(torch.zeros(1, 10, 20, 4), torch.zeros(10, 20, 3))
