"""Continuation: known pixels stay, the others are smooth and lie within the colours around them."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.geometry.pseudo_views import continued


def picture(height: int = 37, width: int = 50) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))


def test_known_pixels_stay_and_unknown_ones_are_not_read():
    image = picture()
    known = torch.rand(image.shape[:2], generator=torch.Generator().manual_seed(1)) > 0.6
    filled = continued(image, known)
    assert torch.equal(filled[known], image[known])
    assert torch.equal(continued(torch.where(known[..., None], image, torch.nan), known), filled)


def test_a_known_image_and_an_unknown_one_come_back_as_they_are():
    image = picture()
    assert torch.equal(continued(image, torch.ones(37, 50, dtype=torch.bool)), image)
    assert torch.equal(continued(image, torch.zeros(37, 50, dtype=torch.bool)), image)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 3), (37, 50), (64, 64)])
def test_one_known_pixel_fills_a_picture_of_any_size_with_its_colour(shape):
    known = torch.zeros(shape, dtype=torch.bool)
    known[shape[0] // 2, shape[1] // 2] = True
    image = picture(*shape)
    assert torch.allclose(continued(image, known), image[known].expand(*shape, 3), atol=1e-6)


def test_a_hole_has_colours_between_those_around_it_without_an_edge():
    ramp = torch.linspace(0, 1, 64)[None, :, None].expand(64, 64, 3)
    known = torch.ones(64, 64, dtype=torch.bool)
    known[20:44, 20:44] = False
    filled = continued(ramp, known)
    inside = filled[20:44, 20:44]
    assert inside.min() >= ramp[0, 18, 0]
    assert inside.max() <= ramp[0, 45, 0]
    assert (inside - ramp[20:44, 20:44]).abs().max() < 0.15
    assert (filled[:, 1:] - filled[:, :-1]).abs().max() < 0.1


def test_far_from_what_is_known_nothing_is_sharp():
    noise = picture(64, 128)
    known = torch.arange(128).expand(64, 128) < 64
    filled = continued(noise, known)
    near, far = (filled[:, a:b].std(dim=0).mean() for a, b in ((64, 66), (110, 128)))
    assert far < 0.3 * near
