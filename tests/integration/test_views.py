"""A host's photos as views: what a mask hides, and what is refused."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.errors import DataError, SettingError
from integration.views import by_name, view
from tests.helpers import toy

PHOTO = toy.scene(20).train[0].lr


def of_host(
    name="photo", sr=lambda name, image, factor: image.repeat_interleave(4, 0).repeat_interleave(4, 1), **settings
):
    c = PHOTO.camera
    K = torch.tensor([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]])
    return view(name, PHOTO.image, c.world_to_camera, K, sr, **settings)


def test_what_a_mask_hides_is_hidden_at_both_scales():
    mask = torch.ones(16, 24)
    mask[:, :6] = 0
    masked = of_host(mask=mask)
    assert torch.equal(masked.lr.shown, mask.bool())
    assert int((~masked.hr.shown).sum()) == 16 * int((~masked.lr.shown).sum())
    assert float(masked.hr.image[:, :24].abs().max()) == 0
    assert of_host().lr.shown is None


def test_an_sr_image_may_overshoot_but_not_have_other_values():
    assert float(of_host(sr=lambda *a: torch.full((64, 96, 3), 1.03)).hr.image.max()) == 1
    with pytest.raises(DataError, match="has values from 200 to 200, must be RGB"):
        of_host(sr=lambda *a: torch.full((64, 96, 3), 200.0))


def test_two_views_of_one_name_are_refused():
    with pytest.raises(SettingError, match=r"'0001\.png' is the name of several"):
        by_name([of_host("0001.png"), of_host("0002.png"), of_host("0001.png")])
