"""What is measured: the four numbers of an image, metrics.json, and the table at the end of a run."""

import inspect
import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies import Photo, View
from clear_strategies.core import images
from clear_strategies.core.points import PointCloud
from clear_strategies.data.scene import Scene
from clear_strategies.outputs import metrics
from clear_strategies.outputs.image_scores import PSNR_CAP, ImageScores, Truth
from clear_strategies.outputs.metrics import NOTE, Evaluation, Part, describe
from rasterizers.interface import Camera
from tests.helpers.image_files import noise


# ---- scores of a scene, and metrics.json
def view(name: str, truth: Tensor, *, known: bool = True) -> View:
    height, width = truth.shape[:2]
    camera = Camera(torch.eye(4), fx=50.0, fy=50.0, cx=width / 2, cy=height / 2, width=width, height=height)
    lr = Photo(camera.scaled(1 / 4), images.downsample(truth, 4))
    return View(name, lr, Photo(camera, images.upsample(lr.image, 4, "nearest")), truth if known else None)


def scene(train: tuple[View, ...], test: tuple[View, ...]) -> Scene:
    return Scene("made up", train, test, PointCloud(torch.zeros(1, 3), torch.zeros(1, 3), "one point"))


def test_each_view_is_scored_by_method_and_the_mean_is_over_views_if_there_are_any() -> None:
    a, b = view("a", noise(0, 48, 64)), view("b", noise(1, 48, 64))
    evaluation = metrics.evaluate(scene((a,), (a, b)), lambda camera: a.truth)  # type: ignore[arg-type,return-value]
    assert set(evaluation.renders) == {"a", "b"}
    assert evaluation.test.views["a"]["ours"].psnr == PSNR_CAP
    assert evaluation.test.views["b"]["bicubic"] == Truth(noise(1, 48, 64)).score(images.upsample(b.lr.image, 4))
    assert evaluation.test.views["b"]["prior"] == Truth(noise(1, 48, 64)).score(b.hr.image)
    assert evaluation.test.mean["ours"].psnr == pytest.approx((PSNR_CAP + evaluation.test.views["b"]["ours"].psnr) / 2)
    assert evaluation.test.against == evaluation.train.against == "HR photos"
    without = metrics.evaluate(scene((a,), ()), lambda camera: a.truth)  # type: ignore[arg-type,return-value]
    assert msgspec.to_builtins(without.test) == {"against": "nothing", "views": {}, "mean": {}}


@pytest.mark.parametrize("known", [True, False])
def test_what_a_mask_hides_has_no_part_in_the_scores(known: bool) -> None:
    shown = torch.ones(12, 16, dtype=torch.bool)
    shown[:, 10:] = False
    a, empty = (view(name, noise(0, 48, 64), known=known) for name in ("a", "empty"))
    a, empty = a.hiding(shown), empty.hiding(torch.zeros_like(shown))
    right = noise(0, 48, 64) if known else a.hr.image
    evaluations = []
    for color in (0.0, 1.0):
        image = torch.where(a.hr.shown[..., None], right, color)
        evaluations.append(metrics.evaluate(scene((a, empty), (a, empty)), lambda camera, image=image: image))
    assert evaluations[0].test == evaluations[1].test
    assert evaluations[0].test.views["a"]["ours"].psnr > (99 if known else 30)
    assert list(evaluations[0].test.views) == list(evaluations[0].train.views) == list(evaluations[0].renders) == ["a"]


def test_of_many_training_views_a_sample_is_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "MOST_TRAIN", 3)
    views = tuple(view(str(i), noise(i, 48, 64)) for i in range(7))
    evaluation = metrics.evaluate(scene(views, ()), lambda camera: torch.zeros(48, 64, 3))
    assert list(evaluation.train.views) == list(evaluation.renders) == ["0", "3", "6"]
    assert evaluation.train.of == 7


def test_without_hr_the_reduced_render_is_compared_with_lr_and_of_hr_photos_it_alone_is_scored() -> None:
    truth = noise(2, 48, 64)
    known, unknown = view("known", truth), view("unknown", truth, known=False)
    evaluation = metrics.evaluate(scene((known, unknown), (unknown,)), lambda camera: truth)
    assert evaluation.test.views["unknown"]["ours"].psnr == PSNR_CAP
    assert set(evaluation.test.views["unknown"]) == {"ours", "prior"}
    assert (evaluation.test.against, evaluation.train.against) == ("LR photos", "HR and LR photos")
    made = view("a", noise(3, 48, 64))
    photos = replace(made, hr=replace(made.hr, image=made.truth), truth=None, hr_is_photo=True).to("cpu")
    evaluation = metrics.evaluate(scene((photos,), (photos,)), lambda camera: photos.hr.image)
    assert set(evaluation.test.views["a"]) == {"ours"}


def test_a_render_that_is_not_finite_has_a_warning_and_null_in_the_file(tmp_path, caplog):
    a = view("a", noise(0, 48, 64))
    evaluation = metrics.evaluate(scene((), (a,)), lambda camera: torch.full((48, 64, 3), math.nan))
    assert "a: its render is not finite" in caplog.text
    metrics.write(tmp_path / "metrics.json", evaluation, scene="made up", seed=3)
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert content["test"]["mean"]["ours"] == {"psnr": None, "ssim": None, "gmsd": None, "blur": None}
    assert content["test"]["views"]["a"]["bicubic"]["psnr"] > 0
    assert (content["scene"], content["seed"]) == ("made up", 3)


def test_metrics_of_ones_own_are_in_the_file_and_the_last_lines_and_one_that_raises_loses_nothing_else(
    tmp_path, caplog
):
    shown = torch.ones(12, 16, dtype=torch.bool)
    shown[:, 10:] = False
    a = view("a", torch.full((48, 64, 3), 0.5))
    own = {"off": lambda image, truth: (image - truth).abs().mean(), "broken": lambda image, truth: image.lpips}
    content = scene((), (a.hiding(shown), replace(a, name="b")))
    evaluation = metrics.evaluate(content, lambda view: torch.full((48, 64, 3), 0.75), own=own)
    means = [evaluation.test.views[name]["ours"].own["off"] for name in "ab"]
    assert means == pytest.approx([0.25 * 10 / 16, 0.25])
    assert "metrics.broken: left out, AttributeError: " in caplog.text
    facts = {"scene": "s", "strategies": [], "seed": 0, "iterations": 1, "gaussians": 1, "seconds": 1, "conflict": {},
             "synthetic_prior": False, "provenance": {}}  # fmt: skip
    metrics.write(tmp_path / "metrics.json", evaluation, **facts)
    scores = metrics.read(tmp_path / "metrics.json", "").test.mean["ours"]
    assert scores.own["off"] == pytest.approx(sum(means) / 2)
    assert math.isnan(scores.own["broken"])
    assert "blur +0.0000   off  0.2031   broken     nan" in describe(Path("run"), evaluation, 1.0, {})


# ---- the table of scores at the end of a run
OURS, BICUBIC = ImageScores(23.5, 0.7, 0.1, 0.01), ImageScores(22.0, 0.5, 0.16, 0.2)
SCORES = {"ours": OURS, "bicubic": BICUBIC, "prior": BICUBIC}


def part(scores: dict[str, ImageScores], against: str = "HR photos", of: int | None = None) -> Part:
    """Of one view, or of none."""
    return Part(against, {"view": scores} if scores else {}, scores, of)


def rows(text: str) -> dict[str, str]:
    return {line[:16].strip(): line[16:].strip() for line in text.splitlines()[1:]}


def test_the_images_that_ours_is_compared_with_stand_below_it() -> None:
    text = describe(
        Path("run"), Evaluation(part(SCORES), part({}), {}), 72.7, {"poses": 60.2, "points": 0.4, "training": 12.0}
    )
    assert text.startswith("done in 1 min 13 s (poses 1 min 0 s, training 12 s): run\n")
    found = rows(text)
    assert list(found)[:3] == [f"test   {name}" for name in ("ours", "bicubic", "prior")]
    assert " ".join(found["test   ours"].split()) == "PSNR 23.50 dB SSIM 0.7000 GMSD 0.1000 blur +0.0100"
    *_, meanings, note, look_next = text.splitlines()
    assert "GMSD" in meanings
    assert note == f"  {NOTE}."
    assert look_next == "  look next: run/contact_sheet.jpg, or clear-strategies view run"


@pytest.mark.parametrize(("folder", "shown"), [("a run", "'a run'"), ("-lead", "./-lead"), ("-a run", "'./-a run'")])
def test_the_command_that_shows_the_run_can_be_copied(folder: str, shown: str) -> None:
    text = describe(Path(folder), Evaluation(part(SCORES), part({}), {}), 1.0, {})
    assert text.endswith(f"or clear-strategies view {shown}")


def test_what_is_missing_has_no_row_and_no_note() -> None:
    def told(test: dict[str, ImageScores], train: dict[str, ImageScores], against: str = "HR photos") -> str:
        return describe(Path("run"), Evaluation(part(test), part(train, against, 200), {}), 12.7, {})

    def images(text: str) -> list[str]:
        return [line.split()[1] for line in text.splitlines() if line.startswith("  train ")]

    assert images(told({}, SCORES)) == ["ours", "bicubic", "prior"]
    assert NOTE not in told({"ours": OURS}, {})
    # An SR image is not compared with the photo that it is made of.
    reduced = told({}, SCORES, against="LR photos")
    assert images(reduced) == ["ours"]
    assert NOTE not in reduced
    assert "train: the HR photos are unknown" in reduced
    assert "train: 1 of the 200 views" in reduced


# ---- the four numbers: by hand, against other implementations, and on photographs that everyone would rank alike
def score(image: Tensor, truth: Tensor, shown: Tensor | None = None) -> ImageScores:
    return Truth(truth, shown).score(image)


def four(scores: ImageScores) -> tuple[float, ...]:
    *numbers, _ = msgspec.structs.astuple(scores)
    return tuple(numbers)


def grey(level: float, height: int = 16, width: int = 16) -> Tensor:
    return torch.full((height, width, 3), level)


@pytest.fixture(scope="module")
def photograph() -> Tensor:
    from skimage import data

    return torch.from_numpy(data.astronaut()[:256, 128:384] / np.float32(255))


def enlarged(truth: Tensor, factor: int) -> Tensor:
    return images.upsample(images.downsample(truth, factor), factor)


def test_an_image_is_perfect_to_itself_two_greys_by_hand_and_what_exceeds_the_range_is_clamped() -> None:
    assert score(noise(0), noise(0)) == ImageScores(psnr=PSNR_CAP, ssim=1.0, gmsd=0.0, blur=0.0)
    scores = score(grey(0.6).double(), grey(0.5).double())
    assert scores.psnr == pytest.approx(20.0)  # -10 log10(0.1²)
    assert scores.ssim == pytest.approx((2 * 0.6 * 0.5 + 1e-4) / (0.6**2 + 0.5**2 + 1e-4))  # no contrast is left
    assert (scores.gmsd, scores.blur) == (0.0, 0.0)  # nor an edge
    assert score(noise(0) * 3 - 1, noise(1)) == score((noise(0) * 3 - 1).clamp(0, 1), noise(1))


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


def test_gmsd_of_one_edge_by_hand_and_as_opencv_has_it(photograph: Tensor) -> None:
    edge = torch.cat([grey(0.4, 16, 8), grey(0.5, 16, 8)], dim=1).double()
    # At half size 2 of 8 columns feel the step of 0.1, with gradient 0.1; elsewhere both images are flat.
    similarity = (170 / 255**2) / (0.1**2 + 170 / 255**2)
    expected = math.sqrt(0.25 * 0.75) * (1 - similarity)
    assert score(edge, grey(0.4).double()).gmsd == pytest.approx(expected)
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
    assert four(there) == pytest.approx(
        four(msgspec.structs.replace(back, blur=-back.blur)), abs=1e-7
    )  # SSIM is in float32


@pytest.mark.parametrize("poison", [math.nan, math.inf])
def test_an_image_that_is_not_finite_has_no_score(poison: float) -> None:
    image = noise(0)
    image[3, 4, 1] = poison
    scores = score(image, noise(0))
    assert all(map(math.isnan, four(scores)))


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


def test_all_four_rank_by_sharpness_and_two_tell_blur_texture_and_displacement_apart(photograph: Tensor) -> None:
    assert_ranked(*(score(enlarged(photograph, factor), photograph) for factor in (1, 2, 4, 8)))
    blurred, texture = enlarged(photograph, 4), noise(0, 256, 256) - 0.5
    of_blurred, of_both = score(blurred, photograph), score(blurred + 0.15 * texture, photograph)
    assert of_blurred.blur > 0.1
    assert score(photograph + 0.08 * texture, photograph).blur < -0.02
    assert abs(of_both.blur) < abs(of_blurred.blur)
    assert of_both.gmsd > of_blurred.gmsd
    displaced = score(photograph.roll(2, dims=1), photograph)
    assert abs(displaced.blur) < 0.01
    assert displaced.gmsd > score(enlarged(photograph, 2), photograph).gmsd


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
    assert four(score(image, photograph, torch.ones_like(shown))) == four(score(image, photograph))


def test_the_last_column_of_an_odd_width_alone_has_all_scores() -> None:
    shown = torch.zeros(14, 15, dtype=torch.bool)
    shown[:, -1] = True
    scores = score(noise(0, 14, 15), noise(1, 14, 15), shown)
    assert all(map(math.isfinite, four(scores)))
    assert scores.gmsd > 0


def test_a_mask_of_one_pixel_hardly_changes_the_scores(photograph: Tensor) -> None:
    shown = torch.ones(photograph.shape[:2], dtype=torch.bool)
    shown[128, 128] = False
    image = enlarged(photograph, 4)
    image[:5] = 0.0  # beside the border, where no window of SSIM has its centre
    assert four(score(image, photograph, shown)) == pytest.approx(four(score(image, photograph)), abs=1e-4)
