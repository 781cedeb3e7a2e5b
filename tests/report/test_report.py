"""The report: its command, its files, its table, its pictures, its rows, and the runs that it finds."""

import csv
import itertools
import math
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from clear_strategies import DataError, files, report
from clear_strategies.data.photo_files import write_png
from clear_strategies.errors import SettingError
from clear_strategies.outputs.figures import SheetRow, window, write_contact_sheet, write_curves
from clear_strategies.settings import CHANGES_NO_RESULT
from tests.helpers.finished_run import averages_of, cells, make_run, rows_of, scores, table_of
from tests.helpers.image_files import array, holds, read
from tests.helpers.pages import DOCS, loaded


def test_a_report_has_a_table_records_a_page_and_images(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.5)):
        make_run(tmp_path / "runs" / str(seed), "+strategy=gco", seed=seed, psnr=psnr)
    make_run(tmp_path / "runs" / "2", "+strategy=clear", psnr=22.0)
    text = report.write(report.collect([tmp_path / "runs"]), tmp_path / "out")
    assert (tmp_path / "out" / "report.md").read_text(encoding="utf-8") == text
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "report.md", "report.csv", "report.html", "comparison_demo.png", "curves_demo.png",
    }  # fmt: skip
    with (tmp_path / "out" / "report.csv").open(newline="", encoding="utf-8") as file:
        records = {record["method"]: record for record in csv.DictReader(file)}
    assert float(records["gco"]["psnr"]) == 20.75
    assert float(records["gco"]["psnr_std"]) == pytest.approx(statistics.stdev((20.0, 21.5)))
    assert float(records["gco"]["gaussians"]) == 1200
    assert float(records["clear"]["psnr_delta"]) == 1.25
    assert (float(records["gco"]["bicubic"]), float(records["gco"]["prior"])) == (18.0, 19.0)


def test_runs_whose_files_or_defaults_changed_between_them_share_no_row_and_the_row_tells_what_changed(tmp_path: Path):
    for seed, iterations in enumerate((1000, 1000, 3000)):
        config = {"fit.iterations": iterations, "fit.seed": seed, "prior.path": f"/{seed}"}
        config |= {"skips.undrawn": 0.05} if seed else {}  # a version before has no such setting
        make_run(tmp_path / str(seed), "experiment=mine", "+strategy=gco", seed=seed, psnr=20.0 + seed, config=config)
    rows = rows_of(tmp_path)
    assert {name: (row["psnr"], row["seeds"]) for name, row in rows.items()} == {
        "gco, fit.iterations=1000": (20.5, "0, 1"),
        "gco, fit.iterations=3000": (22.0, "2"),
    }


def test_the_page_shows_every_table_note_and_picture_as_text_and_refers_to_files_beside_it(tmp_path: Path) -> None:
    for scene in ("fern", "horns"):
        for job, strategy in enumerate(("baseline", "<b>clear</b>")):
            make_run(tmp_path / f"{scene}{job}", f"+strategy={strategy}", "data=llff", scene=scene)
    report.write(report.collect([tmp_path]), tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<b>clear" not in page
    assert page.count("&lt;b&gt;clear&lt;/b&gt;") == 3  # two scenes and their average
    assert "All runs of fern: <code>data=llff</code>." in page
    pictures = set(re.findall(r'src="([^"]+)"', page))
    assert pictures == {f"{kind}_{scene}.png" for kind in ("comparison", "curves") for scene in ("fern", "horns")}
    assert all((tmp_path / picture).is_file() for picture in pictures)
    assert not re.search("http:|https:|<script", page)


def test_runs_without_images_or_history_are_still_in_the_table(tmp_path, caplog):
    run = make_run(tmp_path / "0", "+strategy=gco")
    (run / "history.csv").write_text("t,psnr_test\n1,oops\n")
    (run / "renders" / "view.png").write_bytes(b"no image")
    report.main([str(tmp_path)])
    with pytest.raises(FileExistsError):
        report.main([str(tmp_path), "--out", str(run / "history.csv")])
    assert "its history cannot be drawn" in caplog.text
    assert "there is no comparison image" in caplog.text


def test_the_command_prints_the_table_on_an_ascii_terminal_and_does_not_import_hydra(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", scene="庭院")  # letters that matplotlib's font lacks, too
    code = (
        "import sys; from clear_strategies import report, run; run.program(lambda: report.main([sys.argv[1]])); "
        "sys.exit(9 if {'hydra', 'matplotlib.pyplot'} & set(sys.modules) else 0)"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(Path(report.__file__).parents[2])}
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert r"| \u5ead\u9662    | gco" in done.stdout


def test_without_runs_there_is_no_report(tmp_path, caplog):
    with pytest.raises(DataError, match="there is no finished run here: give the folder of a run or of a sweep"):
        report.collect([tmp_path, tmp_path / "absent"])
    assert f"{tmp_path / 'absent'}: is not there" in caplog.text


def test_empty_columns_are_left_out_and_a_bar_in_a_name_does_not_break_the_table(tmp_path: Path) -> None:
    make_run(tmp_path, "+strategy=gco", conflict={}, scene="a|b")
    header, _, line = table_of(tmp_path).splitlines()[:3]
    assert not {"conflict", "Δ", "best"} & set(header.split())
    assert "a\\|b" in line


def test_the_pictures_of_many_methods_show_the_reference_and_the_best(tmp_path, monkeypatch):
    for number in range(25):
        make_run(tmp_path / f"{number:02}", f"+strategies.gco.tolerance={number}", psnr=30.0 - abs(number - 20))
    drawn = []
    monkeypatch.setattr(report, "_compare_renders", lambda path, scene, runs: drawn.extend(runs))
    monkeypatch.setattr(report, "write_curves", lambda path, histories, title: drawn.append(list(histories)))
    report.main([str(tmp_path)])
    best = [f"gco, +strategies.gco.tolerance={number}" for number in (0, *range(8, 25))]
    assert drawn == [*best, best]


# ---- A comparison enlarges the window where runs differ; charts draw what was measured
def test_a_comparison_enlarges_the_part_where_runs_differ_most(tmp_path: Path) -> None:
    base = array(0, 64, 240)
    other = base.copy()
    other[32:48, 120:180] = array(1, 16, 60)  # a quarter of the size each way, on the grid of windows
    other[0, 0] = 1 - other[0, 0]
    tiles = {"one": base, "two": other}
    row = SheetRow("", {**tiles, "truth": array(2, 64, 240)}, {"one": "20 dB"}, compared=tiles)
    write_contact_sheet(tmp_path / "c.png", [row], "scene · view")
    drawn = read(tmp_path / "c.png")
    for tile in (base, other, array(2, 64, 240)):
        assert holds(drawn, tile[32:48, 120:180], times=4)
    assert window([base, base]) == (slice(24, 40), slice(90, 150))  # equal runs: the centre


def test_runs_differ_most_where_one_is_closer_to_the_truth_not_where_both_are_noisy() -> None:
    truth = np.full((64, 240, 3), 0.5)
    noisy = [truth.copy(), truth.copy()]
    for noise, tile in zip((0.4, -0.4), noisy, strict=True):
        tile[:16, :60] += noise
    noisy[1][32:48, 120:180] += 0.1
    assert window(noisy) == (slice(0, 16), slice(0, 60))
    assert window(noisy, truth) == (slice(32, 48), slice(120, 180))


def history(**columns: float) -> pd.DataFrame:
    rows = [{"t": float(t), "seconds": t / 2, **{k: v + t / 200 for k, v in columns.items()}} for t in range(1, 21)]
    return pd.DataFrame(rows)


@pytest.mark.filterwarnings("error")
def test_runs_without_history_are_not_drawn_and_dollars_are_no_mathematics(tmp_path: Path) -> None:
    runs = {f"run {i} $20_$": history(psnr_test=20.0 + i, conflict=0.1 * i, n_gaussians=100.0) for i in range(9)}
    runs |= {"no LR": history(psnr_test=20.0).assign(loss_lr=0.0)}  # a logarithmic axis has no place for such a loss
    empty = {"empty": pd.DataFrame()}
    for name, shown in {"nine": runs, "ten": runs | empty, "none": empty}.items():
        write_curves(tmp_path / f"{name}.png", shown, "$20_$")
    nine, ten, none = (read(tmp_path / f"{name}.png") for name in ("nine", "ten", "none"))
    assert np.array_equal(nine, ten)
    assert not np.array_equal(nine, none)


def test_a_chart_without_data_says_what_no_strategy_has_logged(tmp_path, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(Axes, "text", lambda axis, x, y, text, **style: said.append(text))
    write_curves(tmp_path / "c.png", {"mine": history(loss_lr=1.0, psnr_test=20.0, conflict=0.1, n_gaussians=9.0)}, "")
    assert said == ["not measured: nothing has logged corrected"]


def test_the_curves_mark_the_iterations_that_reset_opacities(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marked: list[float] = []
    monkeypatch.setattr(Axes, "axvline", lambda axis, x, **style: marked.append(x) or Line2D([], []))
    run = history(loss_lr=0.1, n_gaussians=100.0)
    write_curves(
        tmp_path / "c.png", {"run": run.assign(opacities_reset=[1.0 if t == 7 else math.nan for t in run["t"]])}, ""
    )
    assert marked == [7.0, 7.0]  # over the iterations, where there is something to draw


# ---- seeds are averaged, settings are distinguished, and differences are paired
def test_runs_that_differ_in_their_seed_share_a_row(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.0, 25.0)):
        make_run(tmp_path / str(seed), "+strategy=clear", seed=seed, psnr=psnr)
    assert rows_of(tmp_path)["clear"]["psnr"] == 22.0
    (line,) = (c for c in cells(table_of(tmp_path)) if c["method"] == "clear")
    assert line["PSNR (dB) ↑"] == "22.00 ± 2.65"  # deviations -2, -1, 3: sqrt(14 / 2)
    assert (line["best"], line["seed"], line["Gaussians"]) == ("25.00", "0, 1, 2", "1,200 ± 0")


@pytest.mark.parametrize(
    "setting", ["prior=onnx", "strategies.gco.tolerance=0.1", "~strategies.p2g.patch", "data.cloud.path=dense.ply"]
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


def test_of_one_seed_the_last_run_counts_and_a_score_that_is_not_finite_gives_a_warning(tmp_path, caplog):
    for i, (seed, psnr) in enumerate([(0, 10.0), (0, 20.0), (1, 22.0), (2, None)]):
        make_run(tmp_path / str(i), "+strategy=gco", psnr=psnr, seed=seed)
    row = rows_of(tmp_path)["gco"]
    assert (row["psnr"], row["seeds"]) == (21.0, "0, 1, 2")
    assert f"demo, gco: another run has seed 0, too; {tmp_path / '0'} is left out." in caplog.text
    assert "runs without a finite PSNR are left out of its mean" in caplog.text


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


def test_methods_are_compared_with_the_baseline_or_the_one_that_is_chosen_and_the_table_names_it(tmp_path, capsys):
    for scene, rows in {
        "demo": {"clear": 22.0, "baseline": 20.0, "gco": 21.0},
        "fern": {"gco": 5.0, "clear": 6.0},
    }.items():
        for strategy, psnr in rows.items():
            for seed in (0, 1):
                make_run(
                    tmp_path / scene / f"{strategy}{seed}", f"+strategy={strategy}", psnr=psnr, scene=scene, seed=seed
                )
    made = sorted(tmp_path.glob("*/*"), key=lambda run: ["clear", "baseline", "gco"].index(run.name[:-1]))
    runs = report.collect(made)

    def gains(against: str | None) -> dict[tuple[str, str], tuple[float, bool]]:
        table = report.compare(runs, against)
        return {(row.scene, row.method): (row.psnr_delta, row.reference) for row in table.itertuples()}

    average = "average of 2 scenes"
    assert gains(None) == {
        ("demo", "clear"): (2.0, False), ("demo", "baseline"): (0.0, True), ("demo", "gco"): (1.0, False),
        ("fern", "clear"): (0.0, True), ("fern", "gco"): (-1.0, False),
        (average, "clear"): (0.0, True), (average, "gco"): (-1.0, False),
    }  # fmt: skip
    assert {row for row, (_, it) in gains("gco").items() if it} == {(s, "gco") for s in ("demo", "fern", average)}
    assert gains("gco")["demo", "baseline"] == (-1.0, False)
    report.main([str(tmp_path), "--against", "gco"])
    printed = capsys.readouterr().out
    assert {line["method"] for line in cells(printed) if line["Δ"] == "reference"} == {"gco"}
    assert "Δ: PSNR over the reference, `gco`, dB" in printed
    with pytest.raises(SettingError, match=r"--against: must be a method of the runs, got svs. There are .*gco"):
        report.compare(runs, "svs")


def test_methods_of_two_settings_are_compared_with_the_baseline_of_their_own(tmp_path: Path) -> None:
    for k, (readings, strategy, psnr) in enumerate(
        [
            ("paper", "baseline", 20.0),
            ("measured", "baseline", 21.0),
            ("paper", "clear", 19.5),
            ("measured", "clear", 21.5),
        ]
    ):
        make_run(tmp_path / str(k), f"+strategy={strategy}", f"readings={readings}", psnr=psnr)
    make_run(tmp_path / "4", "+strategy=baseline", "readings=other", psnr=22.0)  # with nothing to compare it with
    gains = {name: (row["psnr_delta"], row["reference"]) for name, row in rows_of(tmp_path).items()}
    assert gains == {
        "baseline, readings=paper": (0.0, True), "baseline, readings=measured": (0.0, True),
        "clear, readings=paper": (-0.5, False), "clear, readings=measured": (0.5, False),
        "baseline, readings=other": (2.0, False),
    }  # fmt: skip
    table = report.compare(report.collect([tmp_path]), "baseline, readings=measured")
    assert list(table["psnr_delta"]) == [-1.0, 0.0, -1.5, 0.5, 1.0]


def test_a_setting_of_its_own_leaves_a_method_the_baseline_of_its_other_settings(tmp_path: Path) -> None:
    for k, (words, psnr) in enumerate(
        [
            (("+strategy=baseline", "fit.z=1"), 30.0),
            (("+strategy=baseline", "++fit.z=3"), 20.0),
            (("+strategy=gco", "strategies.gco.tolerance=0.3", "fit.z=3"), 21.0),
        ]
    ):
        make_run(tmp_path / str(k), *words, psnr=psnr)
    (gain,) = (row["psnr_delta"] for name, row in rows_of(tmp_path).items() if name.startswith("gco"))
    assert gain == 1.0


def test_of_a_setting_that_is_given_twice_the_last_counts(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", "fit.iterations=20")
    make_run(tmp_path / "1", "+strategy=gco", "fit.iterations=20", "fit.iterations=25")
    assert set(rows_of(tmp_path)) == {"gco, fit.iterations=20", "gco, fit.iterations=25"}


def test_without_a_baseline_methods_are_compared_with_the_first_of_their_scene(tmp_path: Path) -> None:
    for job, (strategy, psnr) in enumerate([("baseline", 20.0), *[("gco", 20.5)] * 9, ("clear", 19.25)]):
        make_run(tmp_path / str(job), f"+strategy={strategy}", psnr=psnr, seed=job)
    make_run(tmp_path / "fern", "+strategy=gco", psnr=25.0, scene="fern", synthetic_prior=True)
    lines = cells(table_of(tmp_path))
    assert [line["method"] for line in lines if line["scene"] == "demo"] == ["baseline", "gco", "clear"]
    assert [line["Δ"] for line in lines if line["scene"] == "demo"] == ["reference", "+0.50*", "-0.75*"]
    assert "Δ*: fewer than two seeds are common to both methods" in table_of(tmp_path)
    assert lines[0]["bicubic (dB)"] == "18.00"
    fern = [line for line in lines if line["scene"] == "fern (synthetic prior)"]
    assert (fern[-1]["method"], fern[-1]["Δ"]) == ("gco", "reference")


def test_differences_are_paired_by_seed(tmp_path: Path) -> None:
    for seed, (first, second) in enumerate(((20.0, 20.5), (22.0, 22.25), (21.0, 22.5))):
        make_run(tmp_path / f"a{seed}", "+strategy=baseline", seed=seed, psnr=first)
        make_run(tmp_path / f"b{seed}", "+strategy=gco", seed=seed, psnr=second)
    gco = rows_of(tmp_path)["gco"]
    # Differences 0.5, 0.25, 1.5: mean 0.75, deviations -0.25, -0.5, 0.75, so √(0.875 / 2) / √3.
    assert (gco["psnr_delta"], gco["psnr_delta_pairs"]) == (0.75, 3)
    assert gco["psnr_delta_error"] == pytest.approx((0.875 / 2 / 3) ** 0.5)
    lines = {line["method"]: line for line in cells(table_of(tmp_path))}
    assert (lines["baseline"]["Δ"], lines["gco"]["Δ"]) == ("reference", "+0.75 ± 0.38")
    assert "Δ*" not in table_of(tmp_path)


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


def test_metrics_of_ones_own_have_columns_and_averages_and_lpips_stands_beside_the_papers(tmp_path: Path) -> None:
    for scene, lpips in (("fern", 0.25), ("horns", 0.375)):
        for seed in (0, 1):
            mean = {"ours": {**scores(20.0), "own": {"lpips": lpips + seed / 8, "lost": None}}}
            test = {"against": "HR photos", "views": {"view.png": mean}, "mean": mean}
            settings = ["+strategy=gco", *["+metrics.lpips._target_=lpips.Net"] * seed]
            folder = make_run(tmp_path / f"{scene}{seed}", *settings, seed=seed, scene=scene, test=test)
            files.write_text(folder / ".hydra" / "hydra.yaml", f"  runtime:\n    choices:\n      scene: {scene}\n")
    make_run(tmp_path / "without", "+strategy=svs", scene="fern")
    lines = cells(table_of(tmp_path))
    assert [line["metrics.lpips"] for line in lines] == ["0.3125 ± 0.0884", "", "0.4375 ± 0.0884", "0.3750"]
    assert "metrics.lost" not in lines[0]
    text = report.write(report.collect([tmp_path]), tmp_path)
    (row,) = (row for row in cells(text.partition("LLFF, beside")[2]) if row["method"] == "+ GCO")
    assert row["LPIPS"] == "0.375"


def test_scenes_with_different_data_settings_are_averaged(tmp_path: Path) -> None:
    for scene, shrink in (("fern", 2), ("horns", 4)):
        for job, strategy in enumerate(("baseline", "gco")):
            make_run(tmp_path / f"{scene}{job}", f"+strategy={strategy}", f"data.views.shrink={shrink}", scene=scene)
    make_run(tmp_path / "only_here", "+strategy=gco", "density.threshold=1", "data.views.shrink=2", scene="fern")
    assert list(averages_of(tmp_path).index) == ["baseline", "gco"]


def test_scenes_that_share_no_method_have_no_average(tmp_path: Path) -> None:
    for scene, strategy in (("fern", "baseline"), ("horns", "gco")):
        make_run(tmp_path / scene, f"+strategy={strategy}", scene=scene)
    assert [line["scene"] for line in cells(table_of(tmp_path))] == ["fern", "horns"]


def test_the_papers_numbers_stand_beside_ours(tmp_path: Path) -> None:
    """Means over scenes of means over seeds, rows of other settings below each other; not for other data, views or scales."""
    chosen = {"fern": "scene: fern", "horns": "protocol: llff_x4", "demo": "data: demo"}
    for k, (scene, seed, psnr) in enumerate(
        (("fern", 0, 19.0), ("fern", 1, 21.0), ("horns", 0, 24.0), ("demo", 0, 50.0))
    ):
        for more in ("", "data.views.train=6", "++data.views.sr_scale=2") if k == 0 else ("",):
            for readings in ("paper", "measured"):
                settings = ["+strategy=clear", f"data.scene={scene}", f"readings={readings}", *more.split()]
                folder = make_run(tmp_path / f"{k}{readings}{more}", *settings, seed=seed, psnr=psnr, scene=scene)
                files.write_text(folder / ".hydra" / "hydra.yaml", f"  runtime:\n    choices:\n      {chosen[scene]}\n")
    text = report.write(report.collect([tmp_path]), tmp_path)
    assert "LLFF, beside the paper's numbers" in (tmp_path / "report.html").read_text().replace("&#39;", "'")
    rows = {row["method"]: row for row in cells(text.partition("LLFF, beside the paper's numbers:")[2])}
    assert len(rows) == 15  # one of the 14 twice
    for readings in ("paper", "measured"):
        row = rows[f"CLEAR, readings={readings}"]
        assert (row["PSNR (dB)"], row["PSNR (dB), paper"]) == ("22.00", "20.42")
        assert (row["conflict"], row["conflict, paper"], row["source"]) == ("0.250", "0.162", "Tables 1, 4, 5")
        assert (row["LPIPS"], row["LPIPS, paper"], row["seconds, paper"]) == ("–", "0.266", "612")
    assert (rows["RegNeRF"]["PSNR (dB)"], rows["RegNeRF"]["PSNR (dB), paper"]) == ("–", "15.78")
    assert "Blender, beside" not in text


def test_the_papers_figures_are_drawn_from_a_sweep(tmp_path: Path) -> None:
    """A point for each number of views, a bar for each method, a line for each rung: means over scenes and seeds."""
    figures = loaded(DOCS / "sweep_figures.py")
    for k, (scene, views, strategy) in enumerate(itertools.product(("fern", "horns"), (3, 6), ("baseline", "clear"))):
        share = 0.1 * views + 0.02 * (scene == "horns")
        settings = [f"+strategy={strategy}", f"data.views.train={views}"]
        folder = make_run(tmp_path / str(k), *settings, scene=scene, conflict={"gaussian": share})
        write_png(folder / "views" / "view_lr.png", torch.zeros(6, 8, 3))
        pd.DataFrame({"t": range(100), "conflict": np.linspace(0, share, 100)}).to_csv(folder / "conflict.csv")
    runs = report.collect([tmp_path])
    drawn: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "save", lambda figure, path: drawn.setdefault(path.name, figure))
        for draw in figures.DRAWN.values():
            draw(runs, tmp_path)
    lines = {
        name: [line.get_xydata() for line in drawn[name].axes[0].lines] for name in ("figure1b.svg", "figure5.svg")
    }
    assert len(lines["figure1b.svg"]) == len(lines["figure5.svg"]) == 2  # baseline and clear
    for line in lines["figure1b.svg"]:
        np.testing.assert_allclose(line, [(3, 0.31), (6, 0.61)])
    for line in lines["figure5.svg"]:
        assert len(line) == 50
        np.testing.assert_allclose(line[:, 1], 0.46 * (np.arange(50) * 2 + 0.5) / 99)
    assert [len(axes.patches) for axes in drawn["figure1c.svg"].axes] == [4, 4, 4]  # two scenes and two methods
    for name in ("figure3.png", "figure5_views.png"):
        height, width, _ = read(tmp_path / name).shape
        assert height > 0 < width


@pytest.mark.parametrize(
    ("figure", "named"),
    [
        ("figure1b", "0: data.views.train: is no setting of this run"), ("figure3", "view_lr.png: file: is not there"),
        ("figure5", "conflict.csv: file: cannot be read"), ("training_time", "processor_seconds: has no numbers"),
    ],
)  # fmt: skip
def test_a_figure_refuses_runs_that_it_cannot_be_drawn_from(tmp_path: Path, figure: str, named: str) -> None:
    make_run(tmp_path / "0", "+strategy=gco")
    with pytest.raises(DataError, match=named):
        loaded(DOCS / "figures.py").command([figure, str(tmp_path)])


# ---- finished runs are found, named and read; others are left out with a warning
@pytest.mark.parametrize(
    ("overrides", "facts", "name"),
    [
        (["+strategy=baseline"], {}, "baseline"),
        (["+strategy=[gco,p2g]"], {}, "gco + p2g"),
        (["+strategy=clear_paper"], {"strategies": ["gco", "p2g", "svs"]}, "clear_paper"),
        ([], {"strategies": ["mine", "svs"]}, "mine + svs"),
        (["+strategy=clear", "+method=srgs"], {}, "srgs"),
        (["+strategy=best", "strategy=clear"], {}, "clear"),
        (["+strategy=best", "~strategies.p2g", "~strategies.mcmc"], {}, "best - p2g - mcmc"),
        (["+strategies.veto._target_=your.Veto"], {}, "veto"),
        ([], {"method": "srgs", "strategies": []}, "srgs"),
    ],
    ids=["none", "list", "preset", "without overrides", "a method", "a choice", "left out", "one's own", "in a file"],
)
def test_a_run_is_named_by_its_strategies_as_given_on_the_command_line(tmp_path, overrides, facts, name):
    folder = make_run(tmp_path, *overrides, **facts, **({} if overrides else {"overrides": None}))
    run = report.FinishedRun.read(folder)
    assert (run.name, run.settings) == (name, ())


def test_runs_of_a_sweep_are_in_the_order_of_their_jobs_and_linked_ones_count_once(tmp_path: Path) -> None:
    for number, name in ((2, "a_clear"), (10, "b_more"), (0, "z_baseline")):
        folder = make_run(tmp_path / name, f"+strategy={name[2:]}")
        files.write_text(folder / ".hydra" / "hydra.yaml", f"hydra:\n  job:\n    num: {number}\n")
    assert [run.name for run in report.collect([tmp_path])] == ["baseline", "clear", "more"]
    runs = tmp_path / "runs"
    ours = make_run(runs / "ours", "+strategy=gco")
    (runs / "latest").symlink_to(ours)
    (runs / "sweep").symlink_to(make_run(tmp_path / "disk" / "sweep" / "0", "+strategy=clear").parent)
    assert [run.name for run in report.collect([runs, ours, runs / ".." / "runs" / "ours"])] == ["gco", "clear"]


def test_methods_and_strategies_of_a_sweep_are_in_the_order_of_their_jobs(tmp_path: Path) -> None:
    """Jobs that run at once end in any order."""
    rows = ["+strategy=gco", "+method=srgs", "+strategy=clear"]
    for minute, number in enumerate((1, 2, 0)):
        folder = make_run(
            tmp_path / str(number), rows[number], provenance={"date": f"2026-11-22T10:{minute:02}:00+00:00"}
        )
        files.write_text(folder / ".hydra" / "hydra.yaml", f"hydra:\n  job:\n    num: {number}\n")
    assert [run.name for run in report.collect([tmp_path])] == ["gco", "srgs", "clear"]


def test_sweeps_in_one_folder_stand_one_after_the_other_also_one_that_was_resumed(tmp_path: Path) -> None:
    """Jobs that run at once end in any order, and names of folders say nothing of time."""
    ended = [("m_one", 1), ("z_none", 0), ("b_two", 0), ("n_three", 1), ("a_last", 2), ("o_ther", 0), ("l_resumed", 3)]
    for minute, (name, number) in enumerate(ended):
        provenance, more = {"date": f"2026-11-22T10:{minute:02}:00+00:00"}, ["fit.iterations=9"] * (name == "o_ther")
        folder = make_run(tmp_path / name, f"+strategy={name[2:]}", *more, provenance=provenance)
        files.write_text(folder / ".hydra" / "hydra.yaml", f"hydra:\n  job:\n    num: {number}\n")
    in_order = ["none", "one", "two", "three", "last", "resumed", "ther"]
    assert [run.name for run in report.collect([tmp_path])] == in_order


def test_scenes_of_one_name_with_other_photos_views_or_sizes_are_no_one_scene(tmp_path, caplog):
    def made(folder: str, path: str, cameras: str, **facts: Any) -> None:
        run = make_run(tmp_path / folder, "+strategy=clear", scene="photos", config={"data.path": path}, **facts)
        files.write_text(run / "cameras.json", cameras)

    made("a", "/x/one/photos", "[1]")
    made("b", "/moved/photos", "[1]")  # the same photos
    made("c", "/x/two/photos", "[2]")
    test = {"against": "HR photos", "views": {"other.png": {"ours": scores(3.0)}}, "mean": {"ours": scores(3.0)}}
    made("d", "/x/two/photos", "[2]", test=test)
    scenes = [run.scene for run in report.collect([tmp_path])]
    assert scenes[0] == scenes[1] == "photos of one/photos"
    assert scenes[2:] == ["photos of two/photos, 1 view: view.png", "photos of two/photos, 1 view: other.png"]
    assert "photos: runs of other photos, or scored on other views or at other sizes, are not compared" in caplog.text


@pytest.mark.parametrize(("against", "scored"), [("HR photos", "truth"), ("LR photos", "lr")])
def test_runs_of_one_scene_are_compared_only_at_the_size_at_which_both_are_scored(against, scored, tmp_path, caplog):
    """Against LR photos, HR may be of any size."""
    other = {"truth": "lr", "lr": "truth"}[scored]
    views = {"cam/view.png": {"ours": scores(20.0)}}
    test = {"against": against, "views": views, "mean": {"ours": scores(20.0)}}
    for folder, height, width in (("a", 24, 32), ("b", 24, 32), ("c", 48, 64)):
        run = make_run(tmp_path / folder, "+strategy=clear", test=test)
        write_png(run / "views" / f"cam_view_{scored}.png", torch.zeros(height, width, 3))
        write_png(run / "views" / f"cam_view_{other}.png", torch.zeros(8, 8 + ord(folder), 3))
    marks = "" if against == "HR photos" else f" (against {against})"
    sizes = ["32x24", "32x24", "64x48"]
    assert [run.scene for run in report.collect([tmp_path])] == [f"demo{marks}, scored at {size}" for size in sizes]
    assert "at other sizes, are not compared" in caplog.text
    caplog.clear()
    (run / "views" / f"cam_view_{scored}.png").write_bytes(b"damaged")
    assert {run.scene for run in report.collect([tmp_path])} == {f"demo{marks}"}
    assert not caplog.text


def test_damaged_and_unfinished_runs_are_left_out_with_a_warning(tmp_path, caplog):
    make_run(tmp_path / "good", "+strategy=gco")
    (make_run(tmp_path / "truncated") / "metrics.json").write_text('{"scene": "de')
    (make_run(tmp_path / "list") / "metrics.json").write_text("[]")
    make_run(tmp_path / "no_scores", test={"mean": {"prior": scores(3.0)}})
    make_run(tmp_path / "wrong_type", gaussians="many")
    (tmp_path / "unfinished" / ".hydra").mkdir(parents=True)
    assert [run.folder.name for run in report.collect([tmp_path])] == ["good"]
    for name in ("truncated", "list", "no_scores", "wrong_type", "unfinished"):
        (message,) = (r.getMessage() for r in caplog.records if str(tmp_path / name) in r.getMessage())
        assert "left out" in message
        assert "\n" not in message
