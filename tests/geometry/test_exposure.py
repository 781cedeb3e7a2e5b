"""Photos whose exposure differs come back to the common one; photos that do not differ stay as they are."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from clear_strategies import P2G, DepthMap, Photo, View
from clear_strategies.core import images
from clear_strategies.geometry import exposure_gains
from tests.helpers import planes, toy

DEPTH = 4.0
CASTS = torch.tensor([[1.1, 1.0, 0.95], [0.92, 1.0, 1.08], [1.0, 1.04, 1.0]])


def photos(casts: Tensor) -> list[Photo]:
    """A plane between the brightnesses 0.25 and 0.75, each photo with its cast."""
    shown = planes.plane_photos(3)
    return [replace(p, image=((0.25 + p.image / 2) * cast).clamp(0, 1)) for p, cast in zip(shown, casts, strict=True)]


def depths(*each: float) -> list[DepthMap]:
    return [planes.depth_of(photo, depth) for photo, depth in zip(planes.plane_photos(3), each, strict=False)]


WHOLE = depths(DEPTH, DEPTH, DEPTH)


def test_casts_are_found_up_to_their_geometric_mean_and_photos_without_keep_their_colours():
    gains = exposure_gains(photos(CASTS), WHOLE)
    assert torch.allclose(gains * CASTS, CASTS.log().mean(0).exp().expand(3, 3), atol=1e-3)
    assert torch.allclose(gains.log().mean(0), torch.zeros(3), atol=1e-5)
    assert torch.allclose(exposure_gains(photos(torch.ones(3, 3)), WHOLE), torch.ones(3, 3), atol=1e-5)
    casts = torch.tensor([[1.9, 1.9, 1.9], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    assert float((photos(casts)[0].image == 1).float().mean()) > 0.1
    gains = exposure_gains(photos(casts), WHOLE)
    assert torch.allclose(gains[1] / gains[0], torch.full((3,), 1.9), atol=2e-3)
    gains = exposure_gains(photos(CASTS), depths(DEPTH, DEPTH, torch.nan))
    assert gains[2].tolist() == pytest.approx([1, 1, 1])
    assert torch.allclose(gains[:2], exposure_gains(photos(CASTS)[:2], WHOLE[:2]), atol=1e-6)
    assert exposure_gains(photos(CASTS)[:1], WHOLE[:1]).tolist() == [[1, 1, 1]]
    assert exposure_gains(photos(CASTS)[:2], depths(DEPTH, 1.5 * DEPTH)).tolist() == [[1, 1, 1]] * 2


def test_a_view_is_brightened_at_both_scales_and_its_photo_stays_its_truth():
    lr, hr = planes.photo(), Photo(planes.camera(0, 80, 80), torch.full((80, 80, 3), 0.6))
    gain = torch.tensor([1.5, 2.0, 0.5])
    made = View("v", lr, hr, truth=torch.full((80, 80, 3), 0.5)).brightened(gain)
    assert torch.equal(made.lr.image, (lr.image * gain).clamp(0, 1))
    assert made.hr.image[0, 0].tolist() == pytest.approx([0.9, 1.0, 0.3])
    assert made.truth[0, 0].tolist() == pytest.approx([0.75, 1.0, 0.25])
    photo = View("v", lr, hr, hr_is_photo=True).brightened(gain)
    assert photo.true_hr is photo.hr.image


def test_the_reliability_of_a_brightened_view_is_that_of_its_brightened_images():
    """Back-projection stores what the network's image differed by; the other view still has that image."""
    view = toy.scene().train[0]
    differed = (images.downsample(view.hr.image, 4) - view.lr.image).abs()
    moved = replace(view.hr, image=images.back_projected(view.hr.image, view.lr.image, 4, 10))
    gain = torch.tensor([0.5, 0.6, 0.7])
    stored = replace(view, hr=moved, disagreement=differed).brightened(gain)
    result, expected = (P2G(patch=8).patch_maps(v).reliability for v in (stored, view.brightened(gain)))
    assert torch.allclose(result, expected, atol=0.05)  # up to rounding to 8 bits
