"""The four numbers: by hand, against other implementations, and on photographs that everyone would rank alike."""

from __future__ import annotations

import inspect
import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.view import Photo, View
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.scene import PointCloud, Scene
from clear_strategies.outputs import metrics
from rasterizers.interface import Camera


def grey(level: float, height: int = 16, width: int = 16) -> Tensor:
    return torch.full((height, width, 3), level)


def noise(seed: int, height: int = 24, width: int = 20) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def photograph() -> Tensor:
    from skimage import data

    return torch.from_numpy(data.astronaut()[:256, 128:384] / np.float32(255))


def enlarged(truth: Tensor, factor: int) -> Tensor:
    return images.upsample(images.downsample(truth, factor), factor)


# ── the numbers ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_an_image_is_perfect_to_itself() -> None:
    assert metrics.score(noise(0), noise(0)) == metrics.ImageScores(psnr=metrics.PSNR_CAP, ssim=1.0, gmsd=0.0, blur=0.0)


def test_psnr_and_ssim_of_two_greys_by_hand() -> None:
    scores = metrics.score(grey(0.6).double(), grey(0.5).double())
    assert scores.psnr == pytest.approx(20.0)  # -10 log10(0.1²)
    assert scores.ssim == pytest.approx((2 * 0.6 * 0.5 + 1e-4) / (0.6**2 + 0.5**2 + 1e-4))  # no contrast is left
    assert (scores.gmsd, scores.blur) == (0.0, 0.0)  # nor an edge


def test_black_for_white_has_zero_decibels() -> None:
    assert metrics.score(grey(0.0), grey(1.0)).psnr == 0.0


def test_gmsd_of_one_edge_by_hand() -> None:
    edge = torch.cat([grey(0.4, 16, 8), grey(0.5, 16, 8)], dim=1).double()
    # At half size 2 of 8 columns feel the step of 0.1, with gradient 0.1; elsewhere both images are flat.
    similarity = (170 / 255**2) / (0.1**2 + 170 / 255**2)
    expected = math.sqrt(0.25 * 0.75) * (1 - similarity)
    assert metrics.score(edge, grey(0.4).double()).gmsd == pytest.approx(expected)


def test_gmsd_agrees_with_opencv(photograph: Tensor) -> None:
    cv2 = pytest.importorskip("cv2")
    blurred = enlarged(photograph, 4)
    x, y = ((image.mean(dim=2, keepdim=True) * 255).numpy() for image in (blurred, photograph))
    (theirs, *_), _ = cv2.quality.QualityGMSD_compute(x, y)
    ours = metrics.score(*(torch.from_numpy(image / 255).expand(-1, -1, 3) for image in (x, y))).gmsd
    assert ours == pytest.approx(theirs, rel=0.05)  # their 2x2 blocks begin at another pixel


@given(seed=st.integers(0, 1000), amount=st.floats(0.01, 1))
@settings(max_examples=15, deadline=None)
def test_psnr_is_that_of_scikit_image(seed: int, amount: float) -> None:
    from skimage.metrics import peak_signal_noise_ratio

    truth = noise(seed)
    image = truth + amount * (noise(seed + 1) - truth)
    expected = peak_signal_noise_ratio(truth.double().numpy(), image.double().numpy(), data_range=1)
    assert metrics.score(image, truth).psnr == pytest.approx(expected)


@given(seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_exchanging_image_and_truth_changes_nothing_but_the_sign_of_blur(seed: int) -> None:
    there, back = metrics.score(noise(seed), noise(seed + 1)), metrics.score(noise(seed + 1), noise(seed))
    assert (there.psnr, there.ssim, there.gmsd, there.blur) == pytest.approx(
        (back.psnr, back.ssim, back.gmsd, -back.blur)
    )


def test_what_exceeds_the_range_is_clamped() -> None:
    assert metrics.score(noise(0) * 3 - 1, noise(1)) == metrics.score((noise(0) * 3 - 1).clamp(0, 1), noise(1))


@pytest.mark.parametrize("poison", [math.nan, math.inf])
def test_an_image_that_is_not_finite_has_no_score(poison: float) -> None:
    image = noise(0)
    image[3, 4, 1] = poison
    scores = metrics.score(image, noise(0))
    assert all(map(math.isnan, (scores.psnr, scores.ssim, scores.gmsd, scores.blur)))


def test_images_of_different_or_tiny_size_are_refused() -> None:
    unchecked = inspect.unwrap(metrics.score)  # else the annotations, checked in tests only, speak first
    with pytest.raises(ValueError, match=r"of one size .* got \(16, 16, 3\) and \(16, 18, 3\)"):
        unchecked(grey(0.5), grey(0.5, 16, 18))
    with pytest.raises(ValueError, match=r"at least 12 pixels on each side, got \(11, 16, 3\)"):
        metrics.score(grey(0.5, 11), grey(0.5, 11))


# ── what the measures notice ─────────────────────────────────────────────────────────────────────────────────────────


def assert_ranked(*scores: metrics.ImageScores) -> None:
    """Best first, by each of the four."""
    for better, worse in pairwise(scores):
        assert better.psnr > worse.psnr
        assert better.ssim > worse.ssim
        assert better.gmsd < worse.gmsd
        assert abs(better.blur) < abs(worse.blur)


def test_all_four_rank_truth_then_x2_then_x4_then_x8(photograph: Tensor) -> None:
    assert_ranked(*(metrics.score(enlarged(photograph, factor), photograph) for factor in (1, 2, 4, 8)))


def test_blur_and_invented_texture_are_told_apart_by_sign(photograph: Tensor) -> None:
    textured = photograph + 0.08 * (noise(0, 256, 256) - 0.5)
    assert metrics.score(enlarged(photograph, 4), photograph).blur > 0.1
    assert metrics.score(textured, photograph).blur < -0.02


def test_texture_on_a_blurred_image_mends_blur_but_not_gmsd(photograph: Tensor) -> None:
    blurred = enlarged(photograph, 4)
    textured = blurred + 0.15 * (noise(0, 256, 256) - 0.5)
    without, with_it = metrics.score(blurred, photograph), metrics.score(textured, photograph)
    assert abs(with_it.blur) < abs(without.blur)
    assert with_it.gmsd > without.gmsd


def test_gmsd_notices_displaced_structure_that_blur_cannot_see(photograph: Tensor) -> None:
    scores = metrics.score(photograph.roll(2, dims=1), photograph)
    assert abs(scores.blur) < 0.01
    assert scores.gmsd > metrics.score(enlarged(photograph, 2), photograph).gmsd


@pytest.mark.parametrize("capture", ["fern", "kitchen360", "strecha_fountain", "real_room"])
def test_real_photographs_rank_truth_network_bicubic_x4_bicubic_x8(shared_data: Path, capture: str) -> None:
    cv2 = pytest.importorskip("cv2")
    photos = sorted(p for p in (shared_data / capture).rglob("*") if p.suffix.lower() in {".png", ".jpg"})
    image = read_image(photos[len(photos) // 2])
    top, left = (image.shape[0] - 256) // 2, (image.shape[1] - 256) // 2
    truth = image[top : top + 256, left : left + 256]
    network = cv2.dnn.readNetFromONNX(str(shared_data / "sr_weights" / "span_x4.onnx"))
    network.setInput(images.downsample(truth, 4).permute(2, 0, 1)[None].numpy())
    reference = torch.from_numpy(network.forward()[0]).permute(1, 2, 0)
    candidates = (truth, reference, enlarged(truth, 4), enlarged(truth, 8))
    assert_ranked(*(metrics.score(candidate, truth) for candidate in candidates))


# ── a scene ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def view(name: str, truth: Tensor, *, known: bool = True) -> View:
    height, width = truth.shape[:2]
    camera = Camera(torch.eye(4), fx=50.0, fy=50.0, cx=width / 2, cy=height / 2, width=width, height=height)
    lr = Photo(camera.scaled(1 / 4), images.downsample(truth, 4))
    return View(name, lr, Photo(camera, images.upsample(lr.image, 4, "nearest")), truth if known else None)


def scene(train: tuple[View, ...], test: tuple[View, ...]) -> Scene:
    return Scene("made up", train, test, PointCloud(torch.zeros(1, 3), torch.zeros(1, 3), "one point"))


def test_each_view_is_scored_by_method_and_the_mean_is_over_views() -> None:
    a, b = view("a", noise(0, 48, 64)), view("b", noise(1, 48, 64))
    evaluation = metrics.evaluate(scene((a,), (a, b)), lambda camera: a.truth)  # type: ignore[arg-type,return-value]
    assert set(evaluation.renders) == {"a", "b"}
    assert evaluation.test["a"]["ours"].psnr == metrics.PSNR_CAP
    assert evaluation.test["b"]["bicubic"] == metrics.score(images.upsample(b.lr.image, 4), noise(1, 48, 64))
    assert evaluation.test["b"]["prior"] == metrics.score(b.hr.image, noise(1, 48, 64))
    mean = evaluation.mean("test")
    assert mean is not None
    assert mean.psnr == pytest.approx((metrics.PSNR_CAP + evaluation.test["b"]["ours"].psnr) / 2)
    assert evaluation.against == {"test": "HR photos", "train": "HR photos"}


def test_where_hr_is_unknown_the_reduced_render_is_compared_with_lr() -> None:
    truth = noise(2, 48, 64)
    known, unknown = view("known", truth), view("unknown", truth, known=False)
    evaluation = metrics.evaluate(scene((known, unknown), (unknown,)), lambda camera: truth)
    assert evaluation.test["unknown"]["ours"].psnr == metrics.PSNR_CAP
    assert set(evaluation.test["unknown"]) == {"ours", "prior"}
    assert evaluation.against == {"test": "LR photos", "train": "HR and LR photos"}


def test_a_scene_without_test_views_has_no_mean() -> None:
    a = view("a", noise(0, 48, 64))
    evaluation = metrics.evaluate(scene((a,), ()), lambda camera: a.hr.image)
    assert evaluation.mean("test") is None
    content = metrics.to_json(evaluation)
    assert content["test"] == {"against": "nothing", "views": {}, "mean": {}}


def test_a_render_that_is_not_finite_is_told_and_null_in_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    a = view("a", noise(0, 48, 64))
    evaluation = metrics.evaluate(scene((), (a,)), lambda camera: torch.full((48, 64, 3), math.nan))
    assert "a: its render is not finite" in caplog.text
    files.write_json(tmp_path / "metrics.json", metrics.to_json(evaluation, scene="made up", seed=3))
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert content["test"]["mean"]["ours"] == {"psnr": None, "ssim": None, "gmsd": None, "blur": None}
    assert content["test"]["views"]["a"]["bicubic"]["psnr"] > 0
    assert (content["scene"], content["seed"]) == ("made up", 3)
