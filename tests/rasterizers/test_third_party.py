"""Rasterizers of others: a third party's class by its path, and the backend "gsplat" with our function in place of its own."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import pytest
import torch
from hydra.utils import instantiate

import rasterizers
from rasterizers import (
    BackendUnavailable,
    Camera,
    Rasterizer,
    RasterSettings,
    Rendering,
    Splats,
    Traits,
    autograd,
    gsplat_backend,
)
from rasterizers.gsplat_backend import GsplatRasterizer
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import CHECKS, ContractError, check_gradients_are_finite_differences, check_rasterizer, scene
from tests.helpers.backends import camera


@dataclass(frozen=True, slots=True)
class ThirdParty(RasterSettings):
    """Has a setting of its own, and draws with the reference rasterizer."""

    lanes_per_pass: int = 1 << 18

    @property
    def inner(self) -> ReferenceRasterizer:
        return ReferenceRasterizer(
            lanes=self.lanes_per_pass, **{f.name: getattr(self, f.name) for f in fields(RasterSettings)}
        )

    @property
    def traits(self) -> Traits:
        return self.inner.traits

    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Rendering:
        return self.inner(splats, camera, depth=depth)

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], *, depth: Sequence[bool] | None = None
    ) -> list[Rendering]:
        return self.inner.render_scales(jobs, depth=depth)


class NeedsAutograd(ThirdParty):
    """Would fail where `autograd.draw` draws."""

    def __call__(self, splats, camera, *, depth=False):
        splats.means.clone().requires_grad_().exp().sum().backward()
        return ThirdParty.__call__(self, splats, camera, depth=depth)


class Softer(ThirdParty):
    """Draws other images than the reference, with the right gradients."""

    @property
    def inner(self) -> ReferenceRasterizer:
        return replace(ThirdParty.inner.fget(self), kernel=self.kernel + 1)


class Flat:
    """Draws no depth, and has no argument for it."""

    def __init__(self, **settings) -> None:
        self.inner = rasterizers.load("torch", **settings)

    @property
    def traits(self) -> Traits:
        return replace(self.inner.traits, depth=False, depth_gradient=False)

    def __call__(self, splats, camera):
        return self.inner(splats, camera)

    def render_scales(self, jobs):
        return self.inner.render_scales(jobs)


def test_third_parties_rasterizers_pass_the_checks_and_are_refused_where_depth_is_asked_of_one_without(caplog):
    check_rasterizer(ThirdParty)
    with pytest.raises(ContractError, match=r"this one has no traits, render_scales\. Derive it from .*Backend"):
        check_rasterizer(lambda **_: lambda splats, camera: None)
    target = f"{__name__}.ThirdParty"
    found = instantiate({"_target_": target, "near": 0.01, "background": [1, 1, 1], "lanes_per_pass": 4096})
    assert isinstance(found, Rasterizer)
    assert found == ThirdParty(near=0.01, background=(1.0, 1.0, 1.0), lanes_per_pass=4096)
    with caplog.at_level("INFO", "rasterizers"):
        check_rasterizer(Flat)
    with pytest.raises(RuntimeError, match="does not require grad"):
        check_rasterizer(NeedsAutograd)
    assert "check_nothing_to_draw: depth is not checked, the rasterizer's traits.depth is False" in caplog.text
    splats, camera = scene(5), Camera(torch.eye(4), 40.0, 40.0, 20.0, 15.0, 40, 30)
    assert autograd.draw(Flat(), splats, camera).depth is None
    with pytest.raises(ValueError, match=r"Flat draws no depth \(its traits\.depth is False\)"):
        autograd.draw(Flat(), splats, camera, depth=True)


def test_a_rasterizer_of_other_images_is_checked_without_the_reference():
    check_rasterizer(Softer, reference=False)
    with pytest.raises(ContractError, match=r"off|relative error"):
        check_rasterizer(Softer)


@pytest.fixture
def stand_in(monkeypatch):
    """The backend, with our function in place of gsplat's."""
    ours = functools.partial(autograd.rasterization, backend="torch")
    monkeypatch.setattr(gsplat_backend, "_gsplat_rasterization", lambda: ours)
    return GsplatRasterizer


@pytest.fixture
def gsplat(monkeypatch, stand_in):
    """The same on a CPU."""
    monkeypatch.setattr(GsplatRasterizer, "traits", replace(GsplatRasterizer.traits, devices=frozenset({"cpu"})))
    return stand_in


@pytest.mark.parametrize("check", sorted({*CHECKS} - {check_gradients_are_finite_differences}, key=CHECKS.index))
def test_it_passes_the_checks_that_need_no_other_cut_offs(check, gsplat):
    check(gsplat)


def test_settings_centres_and_refusals_are_those_of_the_underlying_rasterizer(gsplat):
    settings = {"background": (0.2, 0.5, 0.9), "kernel": 0.3, "antialiased": False}
    splats = replace(scene(60), rgb_offset=None)
    found, expected = (make(**settings)(splats, camera()) for make in (gsplat, ReferenceRasterizer))
    assert torch.allclose(found.image, expected.image, rtol=1e-4, atol=1e-5)
    assert torch.allclose(found.means2d, expected.means2d, atol=1e-4)
    assert torch.equal(found.visible, expected.visible)
    splats = scene(10)
    with pytest.raises(ValueError, match="cotangents must be"):
        gsplat()(splats, camera(48, 32)).vjp(torch.zeros(1, 48, 32, 3))
    splats.scales[7] = float("nan")
    with pytest.raises(ValueError, match=r"splats\.scales must be finite; Gaussian 7"):
        gsplat()(splats, camera())


def test_tensors_on_a_cpu_and_other_cut_offs_are_refused(stand_in):
    with pytest.raises(TypeError, match="on cuda, got"):
        stand_in()(scene(5), camera())
    with pytest.raises(ValueError, match=r"alpha_min must stay 0\.00392157, got 0\.000244141"):
        stand_in(alpha_min=1 / 4096)


@pytest.mark.skipif(torch.cuda.is_available(), reason="says what to do without CUDA")
def test_without_cuda_the_error_says_so():
    with pytest.raises(BackendUnavailable, match=r"needs gsplat|draws on CUDA only"):
        rasterizers.load("gsplat")
    assert rasterizers.available()["gsplat"] is not None
