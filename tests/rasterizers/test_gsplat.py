"""The backend "gsplat", with a rasterizer of this package in place of gsplat's function, which needs CUDA."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch

import rasterizers
from rasterizers import BackendUnavailable, autograd
from rasterizers.gsplat_backend import GsplatRasterizer
from rasterizers.testing import pixels_of
from tests.helpers import toy

STAND_IN = functools.partial(autograd.rasterization, backend="torch")


def both(**settings):
    mine = GsplatRasterizer(rasterization=STAND_IN, device="cpu", **settings)
    return mine, rasterizers.load("torch", **settings)


@pytest.mark.parametrize(("offset", "depth"), [(False, False), (True, False), (False, True)])
def test_image_and_vjp_are_those_of_the_underlying_rasterizer(offset, depth):
    mine, reference = both(background=(0.2, 0.5, 0.9), kernel=0.3)
    splats, camera = toy.splats(20), toy.camera(0.2, 48, 32)
    if offset:
        splats = replace(splats, rgb_offset=torch.randn(20, 3, generator=torch.Generator().manual_seed(3)) * 0.2)
    cotangents = torch.randn(2, 32, 48, 3, generator=torch.Generator().manual_seed(0))
    found, expected = mine(splats, camera, depth=depth), reference(splats, camera, depth=depth)
    assert torch.allclose(pixels_of(found), pixels_of(expected), rtol=1e-4, atol=1e-5)
    assert torch.equal(found.visible, expected.visible)
    assert torch.allclose(found.means2d, expected.means2d, atol=1e-4)
    mine_g, reference_g = found.vjp(cotangents), expected.vjp(cotangents)
    for name in ("means", "quats", "scales", "opacities", "screen", "rgb", "basis", "sh0", "shN"):
        a, b = getattr(mine_g, name), getattr(reference_g, name)
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-4 * float(b.abs().max())), name


def test_bad_input_is_refused_with_the_messages_of_every_backend():
    mine, _ = both()
    splats, camera = toy.splats(10), toy.camera(0.0, 48, 32)
    with pytest.raises(ValueError, match="cotangents must be"):
        mine(splats, camera).vjp(torch.zeros(1, 48, 32, 3))
    splats.scales[7] = float("nan")
    with pytest.raises(ValueError, match=r"splats\.scales must be finite; Gaussian 7"):
        mine(splats, camera)


def test_render_scales_draws_each_job():
    mine, _ = both()
    splats, camera = toy.splats(10), toy.camera(0.0, 48, 32)
    low, high = mine.render_scales([(splats, camera.scaled(0.5)), (splats, camera)])
    assert torch.equal(high.image, mine(splats, camera).image)
    assert low.image.shape == (16, 24, 3)


@pytest.mark.parametrize("device", ["cuda:1", "cpu:0"])
def test_a_device_with_a_number_is_refused(device):
    with pytest.raises(ValueError, match=f"device must be cpu or cuda, got '{device}'"):
        GsplatRasterizer(rasterization=STAND_IN, device=device)


def test_other_cut_offs_and_other_devices_are_refused():
    with pytest.raises(ValueError, match="alpha_min must stay"):
        both(alpha_min=1 / 4096)
    with pytest.raises(TypeError, match="on cuda, got"):
        GsplatRasterizer(rasterization=STAND_IN)(toy.splats(5), toy.camera(0.0))


@pytest.mark.skipif(torch.cuda.is_available(), reason="says what to do without CUDA")
def test_without_cuda_the_error_says_so():
    with pytest.raises(BackendUnavailable, match=r"needs gsplat|draws on CUDA only"):
        rasterizers.load("gsplat")
    assert rasterizers.available()["gsplat"] is not None
