"""Rasterizers as torch functions: gradients of the image, and depth to look at."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

import rasterizers
from clear_strategies.geometry.projection import intrinsics
from rasterizers import SplatGradients, Splats, autograd
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import pixels_of, scene
from tests.helpers.backends import camera


def leaves(splats: Splats) -> Splats:
    return Splats(**{f.name: getattr(splats, f.name).clone().requires_grad_() for f in fields(Splats)})


def require_gradients(splats: Splats, screen: torch.Tensor, expected: SplatGradients) -> None:
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert torch.allclose(getattr(splats, name).grad, getattr(expected, name)[0], rtol=1e-9, atol=1e-12), name
    assert torch.allclose(screen, expected.screen[0])


@pytest.mark.parametrize("depth", [False, True])
def test_a_loss_of_the_image_has_the_gradient_of_the_vjp(depth):
    rasterizer, view = ReferenceRasterizer(), camera(40, 30)
    splats = leaves(scene(60, dtype=torch.float64))
    v = torch.randn(30, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    drawn = autograd.draw(rasterizer, splats, view, depth=depth)
    (drawn.image * v).sum().backward()
    expected = rasterizer(splats, view).vjp(v[None])
    require_gradients(splats, drawn.means2d.grad, expected)
    assert torch.allclose(splats.rgb_offset.grad, expected.rgb[0])


def test_a_loss_of_depth_is_refused_rather_than_left_out():
    drawn = autograd.draw(ReferenceRasterizer(), leaves(scene(60)), camera(40, 30), depth=True)
    with pytest.raises(NotImplementedError, match="the loss depends on a rendered depth, which has no gradient"):
        (drawn.image.sum() + drawn.depth.sum()).backward()


def test_depth_that_was_not_asked_for_is_not_drawn():
    assert autograd.draw(ReferenceRasterizer(), scene(5), camera(40, 30)).depth is None


def test_the_stand_in_for_gsplats_rasterization_has_our_rasterizers_gradients():
    """The expected depth is the fourth channel of its images."""
    view, splats = camera(40, 30), replace(leaves(scene(60, dtype=torch.float64)), rgb_offset=None)
    geometry = (
        splats.means, splats.quats, splats.scales, splats.opacities, torch.cat((splats.sh0, splats.shN), 1),
        view.world_to_camera.double()[None], intrinsics(view)[None], 40, 30,
    )  # fmt: skip
    settings = {"sh_degree": 1, "backend": "torch"}
    images, _, info = autograd.rasterization(*geometry, render_mode="RGB+ED", **settings)
    expected = rasterizers.load("torch", kernel=0.3, antialiased=False)(splats, view, depth=True)
    assert torch.allclose(images[0], pixels_of(expected))
    v = torch.randn(1, 30, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (images[..., :3] * v).sum().backward()
    require_gradients(splats, info["means2d"].grad[0], expected.vjp(v))
    with pytest.raises(ValueError, match="needs CUDA"):
        autograd.rasterization(*geometry, render_mode="D", **settings)
