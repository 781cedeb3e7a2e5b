"""Finished runs are found, named and read; others are left out with a warning."""

from __future__ import annotations

from pathlib import Path

import pytest

from clear_strategies import files, report
from clear_strategies.errors import DataError
from tests.helpers.finished_run import make_run, scores


@pytest.mark.parametrize(
    ("overrides", "facts", "name"),
    [
        (["+strategy=baseline"], {}, "baseline"),
        (["+strategy=[gco,p2g]"], {}, "gco + p2g"),
        (["+strategy=clear_paper"], {"strategies": ["gco", "p2g", "svs"]}, "clear_paper"),
        ([], {"strategies": ["mine", "svs"]}, "mine + svs"),
        (["+strategy=clear", "+method=srgs"], {}, "srgs"),
    ],
    ids=["none", "list", "preset", "without overrides", "a method replaces"],
)
def test_a_run_is_named_by_its_strategies_as_given_on_the_command_line(tmp_path, overrides, facts, name):
    folder = make_run(tmp_path, *overrides, **facts, **({} if overrides else {"overrides": None}))
    run = report.Run.read(folder)
    assert (run.name, run.settings) == (name, ())


def test_runs_of_a_sweep_are_in_the_order_of_their_jobs(tmp_path: Path) -> None:
    for number, name in ((2, "a_clear"), (10, "b_more"), (0, "z_baseline")):
        folder = make_run(tmp_path / name, f"+strategy={name[2:]}")
        files.write_text(folder / ".hydra" / "hydra.yaml", f"hydra:\n  job:\n    num: {number}\n")
    assert [run.name for run in report.collect([tmp_path])] == ["baseline", "clear", "more"]


def test_runs_that_are_linked_into_a_folder_belong_to_it_and_count_once(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    ours = make_run(runs / "ours", "+strategy=gco")
    (runs / "latest").symlink_to(ours)
    (runs / "sweep").symlink_to(make_run(tmp_path / "disk" / "sweep" / "0", "+strategy=clear").parent)
    assert [run.name for run in report.collect([runs, ours, runs / ".." / "runs" / "ours"])] == ["gco", "clear"]


def test_damaged_and_unfinished_runs_are_left_out_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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


def test_a_folder_without_a_finished_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no finished run here: give the folder of a run or of a sweep"):
        report.collect([tmp_path, tmp_path / "absent"])
