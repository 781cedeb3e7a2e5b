"""Operators on images, photos before another background, and reduced depth maps."""

from dataclasses import replace

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.core.view import DepthMap, Photo, View
from tests.helpers import toy


def test_resizing_is_downsampling_where_the_factor_is_whole():
    image = torch.rand(12, 20, 3, generator=torch.Generator().manual_seed(0))
    for kernel in ("bicubic", "bilinear", "lanczos", "area"):
        small = images.resize(image, (5, 3), kernel)
        assert torch.allclose(small, images.downsample(image, 4, kernel), atol=1e-6)
    assert torch.equal(images.resize(image, (20, 12)), image)
    finer = image.repeat_interleave(5, 0).repeat_interleave(7, 1)  # of which every 12 x 20 give a pixel of 5 x 7
    assert torch.allclose(images.resize(image, (7, 5), "area"), finer.view(5, 12, 7, 20, 3).mean((1, 3)), atol=1e-6)


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


def test_agreement_is_four_fifths_at_the_median_difference_and_a_half_at_twice_the_median():
    target = torch.full((24, 24, 3), 0.4)
    image = target + 0.1
    image[:8, :8] += 0.1
    weight = images.agreement(image, target)
    torch.testing.assert_close(weight[12:, 12:], torch.full((12, 12, 1), 1 / (1 + 0.5**2)))
    torch.testing.assert_close(
        weight[:6, :6], torch.full((6, 6, 1), 1 / (1 + 1**2))
    )  # of which all 5 x 5 pixels differ so


# ---- photos before another background; a photo and its depth map at a smaller size
def test_a_photo_is_reduced_by_the_smallest_factor_that_suffices():
    photo = Photo(replace(toy.camera(0.0), width=5, height=7), torch.zeros(7, 5, 3))
    for most in range(1, 40):
        factor = photo.factor_to(most)
        width, height = photo.reduced(factor).image.shape[:2]
        assert width * height <= most
        assert factor == 1 or (5 // (factor - 1)) * (7 // (factor - 1)) > most


def test_a_reduced_depth_map_holds_medians_of_what_is_known_and_a_completed_one_changes_nothing_known():
    depth = torch.full((4, 6), torch.nan)
    confidence = torch.zeros(4, 6)
    depth[:2, 0], depth[0, 1] = torch.tensor([1.0, 2.0]), 9.0  # three of four pixels: a median that no outlier moves
    confidence[:2, 0], confidence[0, 1] = 0.5, 0.8
    depth[2, 2], confidence[2, 2] = 3.0, 1.0  # one of four: too few
    small = DepthMap(depth, confidence).reduced(2)
    assert small.depth.shape == (2, 3)
    assert small.depth[0, 0] == 2.0
    assert torch.isclose(small.confidence[0, 0], torch.tensor(0.6))
    assert int(small.known.sum()) == 1
    assert bool(small.depth.isfinite().sum() == 1)
    mine = DepthMap(torch.tensor([[1.0, torch.nan]]), torch.tensor([[0.5, 0.0]]))
    whole = mine.completed_by(DepthMap(torch.tensor([[7.0, 8.0]]), torch.tensor([[0.9, 0.4]])))
    assert whole.depth.tolist() == [[1.0, 8.0]]
    assert torch.equal(whole.confidence, torch.tensor([[0.5, 0.4]]))


def test_a_photo_before_another_background_is_composited_over_it():
    camera, generator = toy.camera(0.0), torch.Generator().manual_seed(0)
    size = (camera.height, camera.width)
    rgb, alpha = torch.rand(*size, 3, generator=generator), torch.rand(*size, generator=generator)

    def over(color):
        image = rgb * alpha[..., None] + torch.tensor(color) * (1 - alpha)[..., None]
        return Photo(camera, image, transparency=1 - alpha)

    white, sky = (1.0, 1.0, 1.0), (0.2, 0.5, 0.9)
    torch.testing.assert_close(over(white).over(sky, white).image, over(sky).image)
    torch.testing.assert_close(over(white).reduced(2).over(sky, white).image, over(sky).reduced(2).image)
    photo = over(white)
    assert photo.over(None, white) is photo
    assert (opaque := photo.over(sky, white)).over(white, sky) is opaque
    assert torch.equal(Photo(camera, rgb).over(sky, white).image, rgb)
    view = View("photo", photo.reduced(2), photo, background=white)
    assert view.brightened(torch.full((3,), 0.5)).lr.transparency is None
