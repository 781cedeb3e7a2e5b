"""The four numbers: by hand, against other implementations, and on photographs that everyone would rank alike."""

from __future__ import annotations

import inspect
import math
from dataclasses import astuple, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.outputs.image_scores import PSNR_CAP, ImageScores, Truth
from tests.helpers.image_files import noise


def score(image: Tensor, truth: Tensor, shown: Tensor | None = None) -> ImageScores:
    return Truth(truth, shown).score(image)


def grey(level: float, height: int = 16, width: int = 16) -> Tensor:
    return torch.full((height, width, 3), level)


@pytest.fixture(scope="module")
def photograph() -> Tensor:
    from skimage import data

    return torch.from_numpy(data.astronaut()[:256, 128:384] / np.float32(255))


def enlarged(truth: Tensor, factor: int) -> Tensor:
    return images.upsample(images.downsample(truth, factor), factor)


# ── the numbers ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_an_image_is_perfect_to_itself() -> None:
    assert score(noise(0), noise(0)) == ImageScores(psnr=PSNR_CAP, ssim=1.0, gmsd=0.0, blur=0.0)


def test_psnr_and_ssim_of_two_greys_by_hand() -> None:
    scores = score(grey(0.6).double(), grey(0.5).double())
    assert scores.psnr == pytest.approx(20.0)  # -10 log10(0.1²)
    assert scores.ssim == pytest.approx((2 * 0.6 * 0.5 + 1e-4) / (0.6**2 + 0.5**2 + 1e-4))  # no contrast is left
    assert (scores.gmsd, scores.blur) == (0.0, 0.0)  # nor an edge


@pytest.mark.parametrize("size", [(12, 12), (13, 37), (97, 1301)])
def test_ssim_is_scikit_images(size: tuple[int, int]) -> None:
    from skimage.metrics import structural_similarity

    truth = images.upsample(noise(0, *size), 3)[: size[0], : size[1]].clamp(0, 1)
    for image in (noise(1, *size), 0.9 * truth + 0.1 * noise(2, *size), 0 * truth):
        theirs = structural_similarity(
            image.double().numpy(), truth.double().numpy(),
            gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2,
        )  # fmt: skip
        assert score(image, truth).ssim == pytest.approx(theirs, abs=1e-6)


def test_gmsd_of_one_edge_by_hand() -> None:
    edge = torch.cat([grey(0.4, 16, 8), grey(0.5, 16, 8)], dim=1).double()
    # At half size 2 of 8 columns feel the step of 0.1, with gradient 0.1; elsewhere both images are flat.
    similarity = (170 / 255**2) / (0.1**2 + 170 / 255**2)
    expected = math.sqrt(0.25 * 0.75) * (1 - similarity)
    assert score(edge, grey(0.4).double()).gmsd == pytest.approx(expected)


def test_gmsd_agrees_with_opencv(photograph: Tensor) -> None:
    cv2 = pytest.importorskip("cv2")
    blurred = enlarged(photograph, 4)
    x, y = ((image.mean(dim=2, keepdim=True) * 255).numpy() for image in (blurred, photograph))
    (theirs, *_), _ = cv2.quality.QualityGMSD_compute(x, y)
    ours = score(*(torch.from_numpy(image / 255).expand(-1, -1, 3) for image in (x, y))).gmsd
    assert ours == pytest.approx(theirs, rel=0.05)  # their 2x2 blocks begin at another pixel


@given(seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_exchanging_image_and_truth_changes_nothing_but_the_sign_of_blur(seed: int) -> None:
    there, back = score(noise(seed), noise(seed + 1)), score(noise(seed + 1), noise(seed))
    assert astuple(there) == pytest.approx(astuple(replace(back, blur=-back.blur)), abs=1e-7)  # SSIM is in float32


def test_what_exceeds_the_range_is_clamped() -> None:
    assert score(noise(0) * 3 - 1, noise(1)) == score((noise(0) * 3 - 1).clamp(0, 1), noise(1))


@pytest.mark.parametrize("poison", [math.nan, math.inf])
def test_an_image_that_is_not_finite_has_no_score(poison: float) -> None:
    image = noise(0)
    image[3, 4, 1] = poison
    scores = score(image, noise(0))
    assert all(map(math.isnan, astuple(scores)))


def test_images_of_different_or_tiny_size_are_refused() -> None:
    unchecked = inspect.unwrap(Truth.score)  # else the annotations, checked in tests only, speak first
    with pytest.raises(ValueError, match=r"the same size, got \(16, 16, 3\) and \(16, 18, 3\)"):
        unchecked(Truth(grey(0.5, 16, 18)), grey(0.5))
    with pytest.raises(ValueError, match=r"at least 12 pixels on each side, got \(11, 16, 3\)"):
        score(grey(0.5, 11), grey(0.5, 11))


# ── what the measures notice ─────────────────────────────────────────────────────────────────────────────────────────


def assert_ranked(*scores: ImageScores) -> None:
    """Best first, by each of the four."""
    for better, worse in pairwise(scores):
        assert better.psnr > worse.psnr
        assert better.ssim > worse.ssim
        assert better.gmsd < worse.gmsd
        assert abs(better.blur) < abs(worse.blur)


def test_all_four_rank_truth_then_x2_then_x4_then_x8(photograph: Tensor) -> None:
    assert_ranked(*(score(enlarged(photograph, factor), photograph) for factor in (1, 2, 4, 8)))


def test_blur_and_gmsd_tell_blur_invented_texture_and_displaced_structure_apart(photograph: Tensor) -> None:
    blurred, texture = enlarged(photograph, 4), noise(0, 256, 256) - 0.5
    of_blurred, of_both = score(blurred, photograph), score(blurred + 0.15 * texture, photograph)
    assert of_blurred.blur > 0.1
    assert score(photograph + 0.08 * texture, photograph).blur < -0.02
    assert abs(of_both.blur) < abs(of_blurred.blur)
    assert of_both.gmsd > of_blurred.gmsd
    displaced = score(photograph.roll(2, dims=1), photograph)
    assert abs(displaced.blur) < 0.01
    assert displaced.gmsd > score(enlarged(photograph, 2), photograph).gmsd


# ── masks ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_hidden_pixels_do_not_count(photograph: Tensor) -> None:
    shown = torch.ones(photograph.shape[:2], dtype=torch.bool)
    shown[:, 100:] = False
    image = (enlarged(photograph, 4) + 0.02 * noise(1, *photograph.shape[:2])).clamp(0, 1)
    masked = score(image, photograph, shown)
    assert score(torch.where(shown[..., None], image, 1.0), photograph, shown) == masked
    alone = score(image[:, :100].contiguous(), photograph[:, :100].contiguous())
    assert masked.psnr == pytest.approx(alone.psnr, abs=1e-4)
    assert masked.ssim == pytest.approx(alone.ssim, abs=0.01)
    assert masked.gmsd == pytest.approx(alone.gmsd, abs=0.01)
    assert astuple(score(image, photograph, torch.ones_like(shown))) == astuple(score(image, photograph))
