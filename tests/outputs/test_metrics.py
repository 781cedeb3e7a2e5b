"""What is measured: metrics.json, the table at the end of a run, and the baseline beside it."""

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
from clear_strategies.errors import DataError
from clear_strategies.outputs import metrics
from clear_strategies.outputs.baseline import Baseline
from clear_strategies.outputs.image_scores import PSNR_CAP, ImageScores, score
from clear_strategies.outputs.metrics import NOTE, Evaluation, Table
from clear_strategies.outputs.score_table import describe, describe_baseline
from rasterizers.interface import Camera
from tests.helpers.finished_run import make_run
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
    assert evaluation.test["b"]["bicubic"] == score(images.upsample(b.lr.image, 4), noise(1, 48, 64))
    assert evaluation.test["b"]["prior"] == score(b.hr.image, noise(1, 48, 64))
    mean = evaluation.mean("test")
    assert mean.psnr == pytest.approx((PSNR_CAP + evaluation.test["b"]["ours"].psnr) / 2)
    assert evaluation.against == {"test": "HR photos", "train": "HR photos"}
    without = metrics.evaluate(scene((a,), ()), lambda camera: a.truth)  # type: ignore[arg-type,return-value]
    assert without.mean("test") is None
    assert metrics.to_json(without)["test"] == {"against": "nothing", "views": {}, "mean": {}}


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


OURS, THEIRS, BICUBIC = (
    ImageScores(23.5, 0.7, 0.1, 0.01), ImageScores(23.09, 0.687, 0.12, -0.02), ImageScores(22.0, 0.5, 0.16, 0.2),
)  # fmt: skip
TABLE: Table = {"view": {"ours": OURS, "bicubic": BICUBIC, "prior": BICUBIC}}
BASELINE = Baseline(Path("run/baseline"), {"test": THEIRS}, {"view": THEIRS}, 11.2)


def rows(text: str) -> dict[str, str]:
    return {line[:25].strip(): line[25:].strip() for line in text.splitlines()[1:]}


def test_the_baseline_and_the_difference_stand_beside_ours() -> None:
    text = describe(Path("run"), Evaluation(TABLE, {}, {}, {}, 0), 12.7, BASELINE)
    assert text.startswith("done in 13 s (the baseline in 11 s): run\n")
    found = rows(text)
    assert list(found)[:5] == [f"test   {n}" for n in ("baseline", "ours", "ours − baseline", "bicubic", "prior")]
    assert found["test   ours − baseline"].split() == [
        "PSNR", "+0.41", "dB", "SSIM", "+0.0130", "GMSD", "-0.0200", "blur", "+0.0300",
    ]  # fmt: skip
    *_, meanings, note, look_next = text.splitlines()
    assert "GMSD" in meanings
    assert note == f"  {NOTE}."
    assert look_next == "  look next: run/contact_sheet.png, or clear-strategies view run"


def test_what_is_missing_has_no_row_and_no_note() -> None:
    def told(*tables: Table, against: str = "HR photos", baseline: Baseline | None = None) -> str:
        return describe(Path("run"), Evaluation(*tables, {"train": against}, {}, 200), 12.7, baseline)

    def images(text: str) -> list[str]:
        return [line.split()[1] for line in text.splitlines() if line.startswith("  train ")]

    # Of the baseline only test views are known.
    assert images(told({}, TABLE, baseline=BASELINE)) == ["ours", "bicubic", "prior"]
    assert "baseline" not in told(TABLE, {})
    assert NOTE not in told({"view": {"ours": OURS}}, {})
    # An SR image is not compared with the photo that it is made of.
    reduced = told({}, TABLE, against="LR photos")
    assert images(reduced) == ["ours"]
    assert NOTE not in reduced
    assert "train: the HR photos are unknown" in reduced
    assert "train: 1 of the 200 views" in reduced


@pytest.mark.parametrize(("means", "said"), [({"test": THEIRS}, ", test views 23.09 dB"), ({}, "")])
def test_the_baseline_is_told_in_one_line(means: dict[str, ImageScores], said: str) -> None:
    told = describe_baseline(Baseline(Path("run/baseline"), means, {}, 11.2))
    assert told == f"the baseline: done in 11 s{said}: run/baseline"


# ---- A baseline beside a run is read from its folder; what is not whole is refused


def test_its_scores_and_its_renders_are_those_of_its_files(tmp_path: Path) -> None:
    baseline = Baseline.read(make_run(tmp_path, psnr=21.5))
    assert (baseline.means["test"].psnr, baseline.means["train"].ssim, baseline.seconds) == (21.5, 0.5, 61.7)
    assert baseline.views["view.png"].psnr == 21.5
    assert baseline.render_of("view.png") == tmp_path / "renders" / "view.png"
    assert baseline.to_json()["test"] == {"psnr": 21.5, "ssim": 0.5, "gmsd": 0.1, "blur": 0.2}


def test_a_number_that_was_not_finite_is_nan_and_a_part_without_views_has_no_mean(tmp_path: Path) -> None:
    baseline = Baseline.read(make_run(tmp_path, psnr=None, test={"against": "nothing", "views": {}, "mean": {}}))
    assert math.isnan(baseline.means["train"].psnr)
    assert set(baseline.means) == {"train"}
    assert "test" not in baseline.to_json()


@pytest.mark.parametrize("key", ["seconds", "test", "train"])
def test_damaged_metrics_are_refused_with_the_remedy(tmp_path: Path, key: str) -> None:
    path = make_run(tmp_path) / "metrics.json"
    content = json.loads(path.read_text())
    files.write_json(path, {name: value for name, value in content.items() if name != key})
    with pytest.raises(DataError, match=r"metrics\.json: .*remove this baseline's metrics.json: it is then"):
        Baseline.read(tmp_path)


def test_a_missing_render_is_refused_before_the_run_trains(tmp_path: Path) -> None:
    (make_run(tmp_path) / "renders" / "view.png").unlink()
    with pytest.raises(DataError, match=r"view\.png: file: is not there"):
        Baseline.read(tmp_path)
