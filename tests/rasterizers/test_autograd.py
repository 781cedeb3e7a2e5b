"""Rasterizers as torch functions: gradients of the image, and depth to look at."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

import rasterizers
from rasterizers import Splats, autograd
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import scene
from tests.helpers.backends import camera


def leaves(splats: Splats) -> Splats:
    return Splats(**{f.name: getattr(splats, f.name).clone().requires_grad_() for f in fields(Splats)})


@pytest.mark.parametrize("depth", [False, True])
def test_a_loss_of_the_image_has_the_gradient_of_the_vjp(depth):
    rasterizer, view = ReferenceRasterizer(), camera(40, 30)
    splats = leaves(scene(60, dtype=torch.float64))
    v = torch.randn(30, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    drawn = autograd.draw(rasterizer, splats, view, depth=depth)
    (drawn.image * v).sum().backward()
    expected = rasterizer(splats, view).vjp(v[None])
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert torch.allclose(getattr(splats, name).grad, getattr(expected, name)[0], rtol=1e-9, atol=1e-12), name
    assert torch.allclose(splats.rgb_offset.grad, expected.rgb[0])
    assert torch.allclose(drawn.means2d.grad, expected.screen[0])


def test_a_loss_of_depth_is_refused_rather_than_left_out():
    drawn = autograd.draw(ReferenceRasterizer(), leaves(scene(60)), camera(40, 30), depth=True)
    with pytest.raises(NotImplementedError, match="the loss depends on a rendered depth, which has no gradient"):
        (drawn.image.sum() + drawn.depth.sum()).backward()


def test_depth_that_was_not_asked_for_is_not_drawn():
    assert autograd.draw(ReferenceRasterizer(), scene(5), camera(40, 30)).depth is None


def test_gsplats_render_mode_with_depth_has_it_as_the_fourth_channel():
    splats, view = scene(60, dtype=torch.float64), camera(40, 30)
    K = torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]], dtype=torch.float64)
    means = splats.means.clone().requires_grad_()
    images, _, _ = autograd.rasterization(
        means, splats.quats, splats.scales, splats.opacities, torch.cat((splats.sh0, splats.shN), 1),
        view.world_to_camera.double()[None], K[None], 40, 30, sh_degree=1, render_mode="RGB+ED", backend="torch",
    )  # fmt: skip
    plain = Splats(*(getattr(splats, f.name) for f in fields(Splats)[:6]))
    expected = rasterizers.load("torch", kernel=0.3, antialiased=False)(plain, view, depth=True)
    assert torch.allclose(images[0, ..., 3], expected.depth)
    assert torch.allclose(images[0, ..., :3], expected.image)
    images[..., :3].sum().backward()
    assert means.grad.abs().sum() > 0
