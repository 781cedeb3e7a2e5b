"""What is measured: metrics.json, and the table at the end of a run."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import Photo, View
from clear_strategies.data.scene import Scene
from clear_strategies.outputs import metrics
from clear_strategies.outputs.image_scores import PSNR_CAP, ImageScores, Truth
from clear_strategies.outputs.metrics import NOTE, Evaluation, Table
from clear_strategies.outputs.score_table import describe
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
    assert evaluation.test["a"]["ours"].psnr == PSNR_CAP
    assert evaluation.test["b"]["bicubic"] == Truth(noise(1, 48, 64)).score(images.upsample(b.lr.image, 4))
    assert evaluation.test["b"]["prior"] == Truth(noise(1, 48, 64)).score(b.hr.image)
    mean = evaluation.mean("test")
    assert mean.psnr == pytest.approx((PSNR_CAP + evaluation.test["b"]["ours"].psnr) / 2)
    assert evaluation.against == {"test": "HR photos", "train": "HR photos"}
    without = metrics.evaluate(scene((a,), ()), lambda camera: a.truth)  # type: ignore[arg-type,return-value]
    assert without.mean("test") is None
    assert metrics.to_json(without)["test"] == {"against": "nothing", "views": {}, "mean": {}}


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
    assert evaluations[0].test["a"]["ours"].psnr > (99 if known else 30)
    assert list(evaluations[0].test) == list(evaluations[0].train) == list(evaluations[0].renders) == ["a"]


def test_of_many_training_views_a_sample_is_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "MOST_TRAIN", 3)
    views = tuple(view(str(i), noise(i, 48, 64)) for i in range(7))
    evaluation = metrics.evaluate(scene(views, ()), lambda camera: torch.zeros(48, 64, 3))
    assert list(evaluation.train) == list(evaluation.renders) == ["0", "3", "6"]
    assert metrics.to_json(evaluation)["train"]["of"] == 7


def test_where_hr_is_unknown_the_reduced_render_is_compared_with_lr() -> None:
    truth = noise(2, 48, 64)
    known, unknown = view("known", truth), view("unknown", truth, known=False)
    evaluation = metrics.evaluate(scene((known, unknown), (unknown,)), lambda camera: truth)
    assert evaluation.test["unknown"]["ours"].psnr == PSNR_CAP
    assert set(evaluation.test["unknown"]) == {"ours", "prior"}
    assert evaluation.against == {"test": "LR photos", "train": "HR and LR photos"}


def test_where_the_hr_side_is_photos_nothing_is_scored_but_the_render() -> None:
    made = view("a", noise(3, 48, 64))
    photos = replace(made, hr=replace(made.hr, image=made.truth))
    assert photos.hr_is_photo
    assert photos.to("cpu").hr_is_photo
    assert not made.hr_is_photo
    evaluation = metrics.evaluate(scene((photos,), (photos,)), lambda camera: photos.hr.image)
    assert set(evaluation.test["a"]) == {"ours"}


def test_a_render_that_is_not_finite_has_a_warning_and_null_in_the_file(tmp_path, caplog):
    a = view("a", noise(0, 48, 64))
    evaluation = metrics.evaluate(scene((), (a,)), lambda camera: torch.full((48, 64, 3), math.nan))
    assert "a: its render is not finite" in caplog.text
    files.write_json(tmp_path / "metrics.json", metrics.to_json(evaluation, scene="made up", seed=3))
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert content["test"]["mean"]["ours"] == {"psnr": None, "ssim": None, "gmsd": None, "blur": None}
    assert content["test"]["views"]["a"]["bicubic"]["psnr"] > 0
    assert (content["scene"], content["seed"]) == ("made up", 3)


# ---- the table of scores at the end of a run


OURS, BICUBIC = ImageScores(23.5, 0.7, 0.1, 0.01), ImageScores(22.0, 0.5, 0.16, 0.2)
TABLE: Table = {"view": {"ours": OURS, "bicubic": BICUBIC, "prior": BICUBIC}}


def rows(text: str) -> dict[str, str]:
    return {line[:16].strip(): line[16:].strip() for line in text.splitlines()[1:]}


def test_the_images_that_ours_is_compared_with_stand_below_it() -> None:
    text = describe(Path("run"), Evaluation(TABLE, {}, {}, {}, 0), 12.7)
    assert text.startswith("done in 13 s: run\n")
    found = rows(text)
    assert list(found)[:3] == [f"test   {name}" for name in ("ours", "bicubic", "prior")]
    assert " ".join(found["test   ours"].split()) == "PSNR 23.50 dB SSIM 0.7000 GMSD 0.1000 blur +0.0100"
    *_, meanings, note, look_next = text.splitlines()
    assert "GMSD" in meanings
    assert note == f"  {NOTE}."
    assert look_next == "  look next: run/contact_sheet.png, or clear-strategies view run"


def test_what_is_missing_has_no_row_and_no_note() -> None:
    def told(*tables: Table, against: str = "HR photos") -> str:
        return describe(Path("run"), Evaluation(*tables, {"train": against}, {}, 200), 12.7)

    def images(text: str) -> list[str]:
        return [line.split()[1] for line in text.splitlines() if line.startswith("  train ")]

    assert images(told({}, TABLE)) == ["ours", "bicubic", "prior"]
    assert NOTE not in told({"view": {"ours": OURS}}, {})
    # An SR image is not compared with the photo that it is made of.
    reduced = told({}, TABLE, against="LR photos")
    assert images(reduced) == ["ours"]
    assert NOTE not in reduced
    assert "train: the HR photos are unknown" in reduced
    assert "train: 1 of the 200 views" in reduced
