"""Expected depth: values worked out by hand, and what it shares with the image. test_compiled.py compares backends."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import rasterizers
from rasterizers.checks import require_cotangents
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import scene, to
from tests.helpers.agreement import require_same_bits
from tests.helpers.backends import CLEAN, backends, balls, camera, cotangents, dense_scene, everything, exact

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


def test_depth_has_no_cotangent():
    with pytest.raises(ValueError, match=r"must be \[K, 10, 20, 3\], got \(1, 10, 20, 4\)"):
        require_cotangents(torch.zeros(1, 10, 20, 4), torch.zeros(10, 20, 3))
