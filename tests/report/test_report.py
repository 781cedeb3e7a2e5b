"""The report: its command, its files, its table, its pictures."""

from __future__ import annotations

import csv
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from clear_strategies import report
from clear_strategies.outputs.contact_sheet import write_contact_sheet
from clear_strategies.outputs.curves import write_curves
from tests.helpers.finished_run import make_run, table_of
from tests.helpers.image_files import array, holds, read

# ---- the command and its files


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


def test_the_page_shows_every_table_note_and_picture_as_text_and_refers_to_files_beside_it(tmp_path: Path) -> None:
    for scene in ("fern", "horns"):
        for job, strategy in enumerate(("baseline", "<b>clear</b>")):
            make_run(tmp_path / f"{scene}{job}", f"+strategy={strategy}", "data=llff", scene=scene)
    report.write(report.collect([tmp_path]), tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<b>clear" not in page
    assert page.count("&lt;b&gt;clear&lt;/b&gt;") == 3  # two scenes and their average
    assert "All runs of fern: `data=llff`." in page
    pictures = set(re.findall(r'src="([^"]+)"', page))
    assert pictures == {f"{kind}_{scene}.png" for kind in ("comparison", "curves") for scene in ("fern", "horns")}
    assert all((tmp_path / picture).is_file() for picture in pictures)
    assert not re.search("http:|https:|<script", page)


def test_scenes_whose_names_differ_by_a_sign_or_are_long_have_pictures_of_their_own() -> None:
    names = report._file_names(("room 1", "room-1", 200 * "ω", "…", "room 1"))
    assert list(names.values()) == ["room_1", "room_1_", 60 * "ω", "scene"]


def test_runs_without_images_or_history_are_still_in_the_table(tmp_path, caplog):
    run = make_run(tmp_path / "0", "+strategy=gco")
    (run / "history.csv").write_text("t,psnr_test\n1,oops\n")
    (run / "renders" / "view.png").write_bytes(b"no image")
    assert report.main([str(tmp_path)]) == 0
    assert "its history cannot be drawn" in caplog.text
    assert "there is no comparison image" in caplog.text


def test_the_command_prints_the_table_on_an_ascii_terminal_and_does_not_import_hydra(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco")
    code = (
        "import sys; from clear_strategies import report; code = report.main([sys.argv[1]]); "
        "sys.exit(9 if {'hydra', 'matplotlib.pyplot'} & set(sys.modules) else code)"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(Path(report.__file__).parents[2])}
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert "| demo  | gco" in done.stdout


def test_without_runs_the_command_logs_one_line_and_exits_with_2(tmp_path, caplog, capsys):
    assert report.main([str(tmp_path)]) == 2
    assert len(caplog.records) == 1
    assert capsys.readouterr().out == ""


# ---- the table leaves out what is empty and notes what a reader has to know


def test_empty_columns_are_left_out_and_a_bar_in_a_name_does_not_break_the_table(tmp_path: Path) -> None:
    make_run(tmp_path, "+strategy=gco", conflict={}, scene="a|b")
    header, _, line = table_of(tmp_path).splitlines()[:3]
    assert not {"conflict", "Δ", "best"} & set(header.split())
    assert "a\\|b" in line


def test_settings_that_all_runs_share_are_noted_once(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", "data=llff", "fit.iterations=600")
    make_run(tmp_path / "1", "+strategy=clear", "data=llff", "fit.iterations=600")
    text = table_of(tmp_path)
    assert "All runs of demo: `data=llff fit.iterations=600`." in text
    assert text.count("data=llff") == 1


# ---- A comparison enlarges the window where runs differ; charts draw what was measured


def test_a_comparison_enlarges_the_part_where_runs_differ_most(tmp_path: Path) -> None:
    base = array(0, 64, 240)
    other = base.copy()
    other[32:48, 120:180] = array(1, 16, 60)  # a quarter of the size each way, on the grid of windows
    other[0, 0] = 1 - other[0, 0]
    rows = report._whole_and_part({"one": base, "two": other}, {"truth": array(2, 64, 240)}, {"one": "20 dB"})
    write_contact_sheet(tmp_path / "c.png", rows, "scene · view")
    drawn = read(tmp_path / "c.png")
    for tile in (base, other, array(2, 64, 240)):
        assert holds(drawn, tile[32:48, 120:180], times=4)
    whole, _ = report._whole_and_part({"one": base, "two": base}, {}, {})
    assert whole.frame == (slice(24, 40), slice(90, 150))  # equal runs: the centre


def history(**columns: float) -> pd.DataFrame:
    rows = [{"t": float(t), "seconds": t / 2, **{k: v + t / 200 for k, v in columns.items()}} for t in range(1, 21)]
    return pd.DataFrame(rows)


@pytest.mark.filterwarnings("error")
def test_runs_without_history_are_not_drawn_and_dollars_are_no_mathematics(tmp_path: Path) -> None:
    runs = {f"run {i} $20_$": history(psnr_test=20.0 + i, conflict=0.1 * i, n_gaussians=100.0) for i in range(9)}
    empty = {"empty": pd.DataFrame()}
    for name, shown in {"nine": runs, "ten": runs | empty, "none": empty}.items():
        write_curves(tmp_path / f"{name}.png", shown, "$20_$")
    nine, ten, none = (read(tmp_path / f"{name}.png") for name in ("nine", "ten", "none"))
    assert np.array_equal(nine, ten)
    assert not np.array_equal(nine, none)
