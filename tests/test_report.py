"""A report says what the runs measured: seeds averaged, settings told apart, what is missing named."""

from __future__ import annotations

import csv
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from clear_strategies import files, report
from clear_strategies.data.photo_files import write_png
from clear_strategies.errors import DataError


def scores(psnr: float | None) -> dict[str, float | None]:
    return {"psnr": psnr, "ssim": 0.5, "gmsd": 0.1, "blur": 0.2}


def make_run(
    folder: Path, *overrides: str, psnr: float | None = 20.0, seed: int = 0, scene: str = "demo", bicubic: float = 18.0,
    **facts: Any,
) -> Path:  # fmt: skip
    """What run.py leaves, as far as a report reads it."""
    mean = {"ours": scores(psnr), "bicubic": scores(bicubic), "prior": scores(bicubic + 1)}
    content = {
        "scene": scene, "strategies": ["gco"], "seed": seed, "iterations": 100, "gaussians": 1200, "seconds": 61.7,
        "conflict": {"gaussian": 0.25, "means": 0.3}, "synthetic_prior": False,
        "test": {"against": "HR photos", "views": {}, "mean": mean},
        "train": {"against": "HR photos", "views": {}, "mean": mean}, "provenance": {}, **facts,
    }  # fmt: skip
    files.write_json(folder / "metrics.json", content)
    overrides = (*overrides, f"fit.seed={seed}")
    files.write_text(folder / ".hydra" / "overrides.yaml", "".join(f"- {o!r}\n" for o in overrides))
    rows = [{"t": t, "psnr_test": 15 + t, "n_gaussians": 1000 + t} for t in range(1, 6)]
    files.write_csv(folder / "history.csv", rows, ["t", "psnr_test", "n_gaussians", "conflict"])
    write_png(folder / "renders" / "view.png", torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(seed)))
    return folder


def rows_of(*folders: Path) -> dict[str, report.Row]:
    return {row.method: row for row in report.table(report.collect(folders))}


def cells(text: str) -> list[dict[str, str]]:
    """The lines of a Markdown table."""
    header, _, *lines = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [{name.strip(): cell.strip() for name, cell in zip(header, line, strict=True)} for line in lines]


# ── which runs share a row ───────────────────────────────────────────────────────────────────────────────────────────


def test_runs_that_differ_in_their_seed_share_a_row(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.0, 25.0)):
        make_run(tmp_path / str(seed), "+strategy=clear", seed=seed, psnr=psnr)
    row = rows_of(tmp_path)["clear"]
    assert row.values["psnr"] == [20.0, 21.0, 25.0]
    (line,) = (c for c in cells(report.markdown([row])) if c["method"] == "clear")
    assert line["PSNR (dB) ↑"] == "22.00 ± 2.65"  # deviations -2, -1, 3: sqrt(14 / 2)
    assert (line["best"], line["seeds"], line["Gaussians"]) == ("25.00", "0, 1, 2", "1,200 ± 0")


@pytest.mark.parametrize(
    "setting", ["prior=onnx", "strategies.gco.tolerance=0.1", "~strategies.p2g", "fit.iterations=9"]
)
def test_runs_that_differ_in_a_setting_have_rows_that_name_it(tmp_path: Path, setting: str) -> None:
    make_run(tmp_path / "0", "+strategy=clear", "data=llff")
    make_run(tmp_path / "1", "+strategy=clear", "data=llff", setting)
    assert {"clear", f"clear, {setting}"} <= set(rows_of(tmp_path))


def test_what_changes_no_result_separates_no_runs(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=clear", "fit.threads=1", "hydra.run.dir=here")
    make_run(tmp_path / "1", "+strategy=clear", "fit.threads=2", "fit.probe_every=7", seed=1)
    assert len(rows_of(tmp_path)["clear"].runs) == 2


def test_strategies_are_named_as_they_were_asked_for(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=baseline", strategies=[])
    make_run(tmp_path / "1", "+strategy=[gco,p2g]", strategies=["gco", "p2g"])
    make_run(tmp_path / "2", "+strategy=clear_paper", strategies=["gco", "p2g", "svs"])
    bare = make_run(tmp_path / "3", strategies=["mine", "svs"])
    (bare / ".hydra" / "overrides.yaml").unlink()
    assert {"baseline", "gco + p2g", "clear_paper", "mine + svs"} <= set(rows_of(tmp_path))


def test_runs_repeated_with_one_seed_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_run(tmp_path / "0", "+strategy=clear")
    make_run(tmp_path / "1", "+strategy=clear")
    rows_of(tmp_path)
    assert "demo, clear: a row holds several runs with the same seed" in caplog.text


# ── the table ────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_sweep_is_a_ladder_from_its_first_job_with_the_baselines_once(tmp_path: Path) -> None:
    for job, (strategy, psnr) in enumerate([("baseline", 20.0), *[("gco", 20.5)] * 9, ("clear", 19.25)]):
        make_run(tmp_path / str(job), f"+strategy={strategy}", psnr=psnr, seed=job)
    lines = cells(report.markdown(report.table(report.collect([tmp_path]))))
    assert [line["method"] for line in lines] == ["bicubic", "prior", "baseline", "gco", "clear"]
    assert [line["Δ"] for line in lines] == ["", "", "+0.00", "+0.50", "-0.75"]
    assert lines[0]["PSNR (dB) ↑"] == "18.00"


def test_baselines_of_different_inputs_stand_apart(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", "prior=onnx")
    make_run(tmp_path / "1", "+strategy=clear", "prior=onnx")
    make_run(tmp_path / "2", "+strategy=gco", "prior=bicubic", bicubic=17.0)
    rows = rows_of(tmp_path)
    assert rows["prior, prior=onnx"].values["psnr"] == [19.0]
    assert rows["prior, prior=bicubic"].values["psnr"] == [18.0]


def test_scenes_keep_their_own_ladder_and_marks(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "+strategy=gco", psnr=20.0, synthetic_prior=True)
    make_run(tmp_path / "b", "+strategy=gco", psnr=25.0, scene="fern")
    make_run(tmp_path / "c", "+strategy=clear", psnr=26.0, scene="fern")
    lines = cells(report.markdown(report.table(report.collect([tmp_path]))))
    found = {(line["scene"], line["method"]): line["Δ"] for line in lines}
    assert found["demo (synthetic prior)", "gco"] == "+0.00"
    assert found["fern", "clear"] == "+1.00"


def test_scores_that_are_not_of_hr_test_views_are_marked(tmp_path: Path) -> None:
    lr = {"against": "LR photos", "views": {}, "mean": {"ours": scores(20.0), "prior": scores(21.0)}}
    nothing: dict[str, Any] = {"against": "nothing", "views": {}, "mean": {}}
    make_run(tmp_path / "a", test=lr, scene="a")
    make_run(tmp_path / "b", test=nothing, train=lr, scene="b")
    scenes = {row.scene for row in report.table(report.collect([tmp_path]))}
    assert scenes == {"a (against LR photos)", "b (training views, against LR photos)"}


def test_columns_that_say_nothing_are_left_out(tmp_path: Path) -> None:
    make_run(tmp_path, "+strategy=gco", conflict={})
    (line,) = (c for c in cells(report.markdown(report.table(report.collect([tmp_path])))) if c["method"] == "gco")
    assert not {"conflict", "Δ", "best"} & set(line)


def test_settings_that_all_runs_share_are_said_once(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", "data=llff", "fit.iterations=600")
    make_run(tmp_path / "1", "+strategy=clear", "data=llff", "fit.iterations=600")
    text = report.markdown(report.table(report.collect([tmp_path])))
    assert "All runs of demo: `data=llff fit.iterations=600`." in text
    assert text.count("data=llff") == 1


def test_a_run_without_a_finite_score_is_said_to_be_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_run(tmp_path / "0", "+strategy=gco", psnr=20.0)
    make_run(tmp_path / "1", "+strategy=gco", psnr=None, seed=1)
    assert rows_of(tmp_path)["gco"].values["psnr"] == [20.0]
    assert "demo, gco: runs without a finite PSNR are left out of its mean" in caplog.text


def test_a_bar_in_a_name_does_not_break_the_table(tmp_path: Path) -> None:
    make_run(tmp_path, "+strategy=gco", scene="a|b")
    assert "a\\|b" in report.markdown(report.table(report.collect([tmp_path])))


# ── the folder ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_damaged_and_unfinished_runs_are_named_and_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_run(tmp_path / "good", "+strategy=gco")
    (make_run(tmp_path / "truncated") / "metrics.json").write_text('{"scene": "de')
    (make_run(tmp_path / "list") / "metrics.json").write_text("[]")
    make_run(tmp_path / "no_scores", test={"mean": {"prior": scores(3.0)}})
    make_run(tmp_path / "wrong_type", gaussians="many")
    (make_run(tmp_path / "bad_yaml") / ".hydra" / "overrides.yaml").write_text("- [a\n")
    (tmp_path / "unfinished" / ".hydra").mkdir(parents=True)
    assert [run.folder.name for run in report.collect([tmp_path])] == ["good"]
    for name in ("truncated", "list", "no_scores", "wrong_type", "bad_yaml", "unfinished"):
        (told,) = (r.getMessage() for r in caplog.records if str(tmp_path / name) in r.getMessage())
        assert "left out" in told
        assert "\n" not in told


def test_a_run_given_twice_counts_once(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco")
    assert len(report.collect([tmp_path, tmp_path / "0", tmp_path / "0" / ".." / "0"])) == 1


def test_a_folder_without_runs_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no finished run here: give the folder of a run or of a sweep"):
        report.collect([tmp_path, tmp_path / "absent"])


def test_the_report_is_a_table_for_readers_one_for_programs_and_pictures(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.5)):
        make_run(tmp_path / "runs" / str(seed), "+strategy=gco", seed=seed, psnr=psnr)
    make_run(tmp_path / "runs" / "2", "+strategy=clear", psnr=22.0)
    text = report.write(report.collect([tmp_path / "runs"]), tmp_path / "out")
    assert (tmp_path / "out" / "report.md").read_text(encoding="utf-8") == text
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "report.md", "report.csv", "report.html", "comparison_demo.png", "curves_demo.png", "psnr_over_seconds_demo.png",
    }  # fmt: skip
    with (tmp_path / "out" / "report.csv").open(newline="", encoding="utf-8") as file:
        records = {record["method"]: record for record in csv.DictReader(file)}
    assert float(records["gco"]["psnr"]) == 20.75
    assert float(records["gco"]["psnr_std"]) == pytest.approx(statistics.stdev((20.0, 21.5)))
    assert float(records["gco"]["gaussians"]) == 1200
    assert float(records["clear"]["psnr_delta"]) == 1.25
    assert (records["bicubic"]["conflict"], records["bicubic"]["psnr_delta"]) == ("", "")


def test_runs_without_pictures_or_history_are_still_tabled(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = make_run(tmp_path / "0", "+strategy=gco")
    (run / "history.csv").write_text("t,psnr_test\n1,oops\n")
    (run / "renders" / "view.png").write_bytes(b"no picture")
    assert report.main([str(tmp_path)]) == 0
    assert "its history cannot be drawn" in caplog.text
    assert "there is no comparison picture" in caplog.text


def test_the_command_prints_the_table_on_any_terminal_and_knows_no_hydra(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco")
    code = (
        "import sys; from clear_strategies import report; code = report.main([sys.argv[1]]); "
        "sys.exit(9 if {'hydra', 'matplotlib.pyplot'} & set(sys.modules) else code)"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(Path(report.__file__).parents[2])}
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (0, 2)
    assert "| demo  | gco" in done.stdout


def test_the_command_says_in_one_line_what_is_wrong_and_exits_with_2(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report.main([str(tmp_path)]) == 2
    assert len(caplog.records) == 1
    assert capsys.readouterr().out == ""
