"""The demo as the loop of a host needs it."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.training.field import GaussianField
from integration.examples.demo import load_demo, splats_with_optimizers
from integration.views import view


def test_the_demo_has_photos_cameras_and_sr_images_that_fit():
    demo = load_demo(width=64, height=48)
    assert demo.images.shape == (3, 12, 16, 3)
    assert len(demo.tests) == 9
    for photo in zip(demo.names, demo.images, demo.viewmats, demo.Ks, strict=True):
        one = view(*photo, sr=demo.prior)
        assert one.hr.image.shape == (48, 64, 3)
    assert demo.psnr(lambda viewmat, K, w, h: torch.zeros(h, w, 3)) < 15
    truths = iter([truth for _, _, truth in demo.tests])
    assert demo.psnr(lambda viewmat, K, w, h: next(truths) + 0.01) == pytest.approx(40, abs=1)


def test_splats_start_as_those_of_the_trainer():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    splats, optimizers = splats_with_optimizers(points, points.flip(0))
    start = GaussianField.from_cloud(PointCloud(points, points.flip(0), "test")).raw()
    assert set(splats) == set(optimizers) == set(start) - {"detail"}
    for name, p in splats.items():
        assert torch.allclose(p, start[name], atol=2e-3), name
        assert optimizers[name].param_groups[0]["params"][0] is p


def test_a_single_point_has_a_size():
    splats, _ = splats_with_optimizers(torch.zeros(1, 3), torch.zeros(1, 3))
    assert splats["scales"].isfinite().all()
