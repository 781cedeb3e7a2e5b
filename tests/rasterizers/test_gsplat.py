"""The backend "gsplat", with a rasterizer of this package in place of gsplat's function, which needs CUDA."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch

import rasterizers
from rasterizers import BackendUnavailable, autograd
from rasterizers.gsplat_backend import GsplatRasterizer
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import CHECKS, check_gradients_are_finite_differences, scene
from tests.helpers.backends import camera

stand_in = functools.partial(GsplatRasterizer, rasterization=functools.partial(autograd.rasterization, backend="torch"))
gsplat = functools.partial(stand_in, device="cpu")


@pytest.mark.parametrize("check", sorted({*CHECKS} - {check_gradients_are_finite_differences}, key=CHECKS.index))
def test_it_passes_the_checks_that_need_no_other_cut_offs(check):
    check(gsplat)


def test_settings_centres_and_visible_gaussians_are_those_of_the_underlying_rasterizer():
    settings = {"background": (0.2, 0.5, 0.9), "kernel": 0.3, "antialiased": False}
    splats = replace(scene(60), rgb_offset=None)
    found, expected = (make(**settings)(splats, camera()) for make in (gsplat, ReferenceRasterizer))
    assert torch.allclose(found.image, expected.image, rtol=1e-4, atol=1e-5)
    assert torch.allclose(found.means2d, expected.means2d, atol=1e-4)
    assert torch.equal(found.visible, expected.visible)


def test_bad_input_is_refused_with_the_messages_of_every_backend():
    splats = scene(10)
    with pytest.raises(ValueError, match="cotangents must be"):
        gsplat()(splats, camera(48, 32)).vjp(torch.zeros(1, 48, 32, 3))
    splats.scales[7] = float("nan")
    with pytest.raises(ValueError, match=r"splats\.scales must be finite; Gaussian 7"):
        gsplat()(splats, camera())
    with pytest.raises(TypeError, match="on cuda, got"):
        stand_in()(scene(5), camera())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"device": "cuda:1"}, "device must be cpu or cuda, got 'cuda:1'"),
        ({"alpha_min": 1 / 4096}, "alpha_min must stay 0.00392157, got 0.000244141"),
    ],
)
def test_numbered_devices_and_other_cut_offs_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        stand_in(**settings)


@pytest.mark.skipif(torch.cuda.is_available(), reason="says what to do without CUDA")
def test_without_cuda_the_error_says_so():
    with pytest.raises(BackendUnavailable, match=r"needs gsplat|draws on CUDA only"):
        rasterizers.load("gsplat")
    assert rasterizers.available()["gsplat"] is not None
