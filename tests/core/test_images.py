"""Operators on images: resizing agrees with downsampling, and the area mean with its VJP."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.core import images


def test_resizing_is_downsampling_where_the_factor_is_whole():
    image = torch.rand(12, 20, 3, generator=torch.Generator().manual_seed(0))
    for kernel in ("bicubic", "bilinear", "lanczos", "area"):
        small = images.resize(image, (5, 3), kernel)
        assert torch.allclose(small, images.downsample(image, 4, kernel), atol=1e-6)
    assert torch.equal(images.resize(image, (20, 12)), image)
    assert images.resize(image, (7, 5), "area").shape == (5, 7, 3)


def test_the_area_mean_and_its_vjp_are_adjoint():
    g = torch.Generator().manual_seed(1)
    x, y = torch.randn(8, 12, 3, generator=g), torch.randn(2, 3, 3, generator=g)
    left = (images.area_mean(x, 4) * y).sum()
    right = (x * images.area_mean_transposed(y[None], 4)[0]).sum()
    assert float(left) == pytest.approx(float(right), rel=1e-5)


@pytest.mark.parametrize("down", ["bicubic", "bilinear", "lanczos", "area"])
def test_back_projection_moves_an_image_until_it_shrinks_to_the_photo(down):
    g = torch.Generator().manual_seed(2)
    truth = images.upsample(torch.rand(16, 20, 3, generator=g), 4)
    lr = images.downsample(truth, 4, down)
    sr = (truth + 0.1 * torch.randn(truth.shape, generator=g) - 0.05).clamp(0, 1)  # another shade, and noise

    def disagreement(image: torch.Tensor) -> float:
        return float((images.downsample(image, 4, down) - lr).abs().mean())

    moved = images.back_projected(sr, lr, 4, 10, down)
    assert disagreement(moved) < 0.05 * disagreement(sr)
    assert float((moved - truth).square().mean()) < float((sr - truth).square().mean())
    assert torch.equal(images.back_projected(sr, lr, 4, 0, down), sr)
    left = torch.zeros(64, 80, 1)
    left[:, :40] = 1
    assert torch.equal(images.back_projected(sr, lr, 4, 3, down, where=left)[:, 40:], sr[:, 40:])
