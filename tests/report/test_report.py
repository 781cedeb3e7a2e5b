"""The command and its files."""

from __future__ import annotations

import csv
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

from clear_strategies import report
from tests.helpers.finished_run import make_run


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
    assert (records["bicubic"]["conflict"], records["bicubic"]["psnr_delta"]) == ("", "")


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
