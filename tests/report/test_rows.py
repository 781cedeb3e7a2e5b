"""Seeds are averaged, settings are distinguished, and differences are paired."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from clear_strategies import report
from clear_strategies.settings import CHANGES_NO_RESULT
from tests.helpers.finished_run import averages_of, cells, make_run, rows_of, scores, table_of


def test_runs_that_differ_in_their_seed_share_a_row(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.0, 25.0)):
        make_run(tmp_path / str(seed), "+strategy=clear", seed=seed, psnr=psnr)
    assert rows_of(tmp_path)["clear"]["psnr"] == 22.0
    (line,) = (c for c in cells(table_of(tmp_path)) if c["method"] == "clear")
    assert line["PSNR (dB) ↑"] == "22.00 ± 2.65"  # deviations -2, -1, 3: sqrt(14 / 2)
    assert (line["best"], line["seeds"], line["Gaussians"]) == ("25.00", "0, 1, 2", "1,200 ± 0")


@pytest.mark.parametrize(
    "setting", ["prior=onnx", "strategies.gco.tolerance=0.1", "~strategies.p2g", "data.cloud.path=dense.ply"]
)
def test_runs_that_differ_in_a_setting_have_rows_that_name_it(tmp_path: Path, setting: str) -> None:
    make_run(tmp_path / "0", "+strategy=clear", "data=llff")
    make_run(tmp_path / "1", "+strategy=clear", "data=llff", setting)
    assert {"clear", f"clear, {setting}"} <= set(rows_of(tmp_path))


@pytest.mark.parametrize(
    ("settings", "others"),
    [
        (["fit.threads=1", "hydra.run.dir=here"], [f"{key}=2" for key in CHANGES_NO_RESULT]),
        (["+scene=fern"], ["data.path=elsewhere/fern", "data.reader.path=x"]),
        (["mip.every=9", "density.every=50"], ["density.every=50", "mip.every=9"]),
    ],
    ids=["without influence", "paths and scenes", "order"],
)
def test_what_changes_no_result_does_not_separate_runs(tmp_path: Path, settings: list[str], others: list[str]) -> None:
    make_run(tmp_path / "0", "+method=srgs", *settings)
    make_run(tmp_path / "1", "+method=srgs", *others, seed=1)
    assert rows_of(tmp_path)["srgs"]["seeds"] == "0, 1"


def test_one_seed_twice_and_a_score_that_is_not_finite_give_a_warning(tmp_path, caplog):
    for i, psnr in enumerate((20.0, 20.0, None)):
        make_run(tmp_path / str(i), "+strategy=gco", psnr=psnr)
    assert rows_of(tmp_path)["gco"]["psnr"] == 20.0
    assert "demo, gco: a row holds several runs with the same seed" in caplog.text
    assert "demo, gco: runs without a finite PSNR are left out of its mean" in caplog.text


def test_each_method_has_the_psnr_of_its_own_sr_images_and_of_bicubic(tmp_path: Path) -> None:
    for scene in ("fern", "horns"):
        make_run(tmp_path / f"{scene}0", "+strategy=clear", scene=scene)
        make_run(tmp_path / f"{scene}1", "+strategy=best", scene=scene, bicubic=20.0)
    rows = rows_of(tmp_path / "fern0", tmp_path / "fern1")
    for name, bicubic in {"clear": 18.0, "best": 20.0}.items():
        for row in (rows[name], averages_of(tmp_path).loc[name]):
            assert (row["bicubic"], row["prior"]) == (bicubic, bicubic + 1)


def test_scores_of_training_views_or_against_lr_photos_are_marked(tmp_path: Path) -> None:
    lr = {"against": "LR photos", "views": {}, "mean": {"ours": scores(20.0), "prior": scores(21.0)}}
    nothing: dict[str, Any] = {"against": "nothing", "views": {}, "mean": {}}
    make_run(tmp_path / "a", test=lr, scene="a")
    make_run(tmp_path / "b", test=nothing, train=lr, scene="b")
    scenes = set(report.compare(report.collect([tmp_path]))["scene"])
    assert scenes == {"a (against LR photos)", "b (training views, against LR photos)"}


def test_methods_are_compared_with_the_first_of_their_scene(tmp_path: Path) -> None:
    for job, (strategy, psnr) in enumerate([("baseline", 20.0), *[("gco", 20.5)] * 9, ("clear", 19.25)]):
        make_run(tmp_path / str(job), f"+strategy={strategy}", psnr=psnr, seed=job)
    make_run(tmp_path / "fern", "+strategy=gco", psnr=25.0, scene="fern", synthetic_prior=True)
    lines = cells(table_of(tmp_path))
    assert [line["method"] for line in lines if line["scene"] == "demo"] == ["baseline", "gco", "clear"]
    assert [line["Δ"] for line in lines if line["scene"] == "demo"] == ["+0.00", "+0.50", "-0.75"]
    assert lines[0]["bicubic (dB)"] == "18.00"
    fern = [line for line in lines if line["scene"] == "fern (synthetic prior)"]
    assert (fern[-1]["method"], fern[-1]["Δ"]) == ("gco", "+0.00")


def test_differences_are_paired_by_seed(tmp_path: Path) -> None:
    for seed, (first, second) in enumerate(((20.0, 20.5), (22.0, 22.25), (21.0, 22.5))):
        make_run(tmp_path / f"a{seed}", "+strategy=baseline", seed=seed, psnr=first)
        make_run(tmp_path / f"b{seed}", "+strategy=gco", seed=seed, psnr=second)
    gco = rows_of(tmp_path)["gco"]
    # Differences 0.5, 0.25, 1.5: mean 0.75, deviations -0.25, -0.5, 0.75, so √(0.875 / 2) / √3.
    assert (gco["psnr_delta"], gco["psnr_delta_pairs"]) == (0.75, 3)
    assert gco["psnr_delta_error"] == pytest.approx((0.875 / 2 / 3) ** 0.5)
    lines = {line["method"]: line for line in cells(table_of(tmp_path))}
    assert (lines["baseline"]["Δ"], lines["gco"]["Δ"]) == ("+0.00", "+0.75 ± 0.38")


def test_averages_are_means_of_scene_means_with_paired_differences(tmp_path: Path) -> None:
    for scene, offset in (("fern", 0.0), ("horns", 4.0)):
        for seed in (0, 1, 2)[: 3 if scene == "fern" else 1]:
            psnr = 20.0 + offset + seed
            make_run(tmp_path / f"{scene}a{seed}", "+strategy=baseline", seed=seed, psnr=psnr, scene=scene)
            make_run(tmp_path / f"{scene}b{seed}", "+strategy=gco", seed=seed, psnr=psnr + 1 + offset, scene=scene)
    averages = averages_of(tmp_path)
    assert set(averages["scene"]) == {"average of 2 scenes"}
    assert list(averages.index) == ["baseline", "gco"]
    assert averages.loc["baseline", "psnr"] == 22.5  # 21 and 24: each scene counts once, however many seeds it has
    gco = averages.loc["gco"]
    assert (gco["psnr_delta"], gco["psnr_delta_pairs"]) == (2.0, 4)  # 1, 1, 1, 5
    assert gco["psnr_delta_error"] == pytest.approx(1.0)  # s = 2
    line = cells(table_of(tmp_path))[-1]
    assert (line["PSNR (dB) ↑"], line["Δ"]) == ("25.50", "+2.00 ± 1.00")


def test_scenes_with_different_data_settings_are_averaged(tmp_path: Path) -> None:
    for scene, shrink in (("fern", 2), ("horns", 4)):
        for job, strategy in enumerate(("baseline", "gco")):
            make_run(tmp_path / f"{scene}{job}", f"+strategy={strategy}", f"data.views.shrink={shrink}", scene=scene)
    make_run(tmp_path / "only_here", "+strategy=gco", "density.threshold=1", "data.views.shrink=2", scene="fern")
    assert list(averages_of(tmp_path).index) == ["baseline", "gco"]
