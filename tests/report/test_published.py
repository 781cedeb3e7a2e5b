"""The paper's numbers stand beside ours, with what differs."""

from __future__ import annotations

import csv
from pathlib import Path

from clear_strategies import report
from tests.helpers.finished_run import cells, make_run


def test_published_numbers_stand_right_of_ours_and_the_notes_name_the_differences(tmp_path: Path) -> None:
    plan = {"train views": "3: a, b, c", "HR": "504x376 (x4), SR images: onnx span.onnx", "initial points": "9,199: LR"}
    make_run(tmp_path / "0", "+method=dropgaussian", provenance={"plan": plan}, iterations=1500)
    make_run(tmp_path / "1", "+strategy=clear", "density.threshold=1e-3", provenance={"plan": plan}, iterations=1500)
    make_run(tmp_path / "2", "+strategy=mine", provenance={"plan": plan}, iterations=1500)
    report.write(report.collect([tmp_path]), tmp_path, paper="llff")
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    lines = {line["method"]: line for line in cells(text)}
    assert list(lines["mine"])[2:4] == ["PSNR (dB) ↑", "PSNR, paper"]
    assert (lines["dropgaussian"]["PSNR, paper"], lines["dropgaussian"]["LPIPS, paper"]) == ("18.57", "0.390")
    assert lines["clear, density.threshold=1e-3"]["SSIM, paper"] == "0.682"
    assert (lines["mine"]["PSNR, paper"], lines["mine"]["LPIPS, paper"]) == ("", "")
    for phrase in (
        "Table 1", "1,500 iterations", "HR 504x376", "onnx span.onnx", "9,199: LR", "S2Gaussian 20.17 / 0.640",
    ):  # fmt: skip
        assert phrase in text, phrase
    assert "training views (" not in text  # three, as in the protocol
    with (tmp_path / "report.csv").open(newline="", encoding="utf-8") as file:
        assert {r["method"]: r["paper_psnr"] for r in csv.DictReader(file)}["dropgaussian"] == "18.57"


def test_each_step_of_the_ablation_finds_its_published_line(tmp_path: Path) -> None:
    for job, strategy in enumerate(("baseline", "gco", "[gco,p2g]", "clear")):
        make_run(tmp_path / str(job), f"+strategy={strategy}")
    report.write(report.collect([tmp_path]), tmp_path, paper="ablation")
    lines = cells((tmp_path / "report.md").read_text(encoding="utf-8"))
    assert [line["PSNR, paper"] for line in lines] == ["", "", "18.74", "19.72", "20.09", "20.42"]
    assert [line["conflict, paper"] for line in lines][2:] == ["0.243", "0.228", "0.210", "0.162"]
